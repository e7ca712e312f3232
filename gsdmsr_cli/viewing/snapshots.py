"""Snapshots of a training for whoever looks: written only while somebody does, and not often."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from gsdmsr_cli.ground.files import replacing

FOLDER = "view"
"""Of a run folder."""

SNAPSHOT, MARK = "snapshot.dsplat", "wanted"

FRESH = 10.0
"""For how long after a mark somebody is taken to look [s]."""

EVERY = 5.0
"""Least time between two snapshots [s]."""

SHARE = 0.04
"""Of the training's time that snapshots take at most."""


def snapshot_path(root: Path) -> Path:
    """Return where the snapshot of a run is."""
    return root / FOLDER / SNAPSHOT


def mark(root: Path) -> None:
    """Say that somebody looks; a folder that cannot be written has no snapshots."""
    with suppress(OSError):
        (root / FOLDER).mkdir(exist_ok=True)
        (root / FOLDER / MARK).touch()


def forget(root: Path) -> None:
    """Remove what was written for whoever has looked at a run."""
    with suppress(OSError):
        for name in (SNAPSHOT, MARK):
            (root / FOLDER / name).unlink(missing_ok=True)
        (root / FOLDER).rmdir()


class Snapshots:
    """The side of the training: asked now and then, it writes a snapshot if that is due."""

    def __init__(
        self, root: Path, make: Callable[[], bytes], now: Callable[[], float] = time.time
    ) -> None:
        """Write none yet.

        Args:
            root: the run folder.
            make: returns the file of the present splats.
            now: the time, by the clock that files have [s].
        """
        self._root, self._make, self._now = root, make, now
        self._due = 0.0

    def offer(self) -> bool:
        """Write a snapshot if somebody looks and the last one is old enough; return whether.

        Raises:
            DataError: it cannot be written.
        """
        began = self._now()
        if began < self._due or not self._somebody_looks(began):
            return False
        data = self._make()
        with replacing(snapshot_path(self._root), durable=False) as beside:
            beside.write_bytes(data)
        ended = self._now()
        self._due = ended + max(EVERY, (ended - began) / SHARE)
        return True

    def _somebody_looks(self, now: float) -> bool:
        try:
            marked = (self._root / FOLDER / MARK).stat().st_mtime
        except OSError:
            return False
        return now - marked < FRESH
