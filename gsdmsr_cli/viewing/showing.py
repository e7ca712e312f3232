"""What the page of a run is told: its splats, how the training stands, a held-out view."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import time_left
from gsdmsr_cli.moving.container import WRONG, from_bytes
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.moving.quick import quick_file
from gsdmsr_cli.runs.moving_file import bytes_of
from gsdmsr_cli.runs.run import Run, open_run, open_with_model
from gsdmsr_cli.viewing import snapshots
from gsdmsr_cli.viewing.held_out import HeldOut
from gsdmsr_cli.viewing.server import Answer, Pages, document

QUIET = 30.0
"""A training that has logged nothing for so long is over, or stands still [s]."""

MOST_POINTS = 400
"""Of the curve over time that are sent."""


class Showing:
    """A run, or a file in place of one, as its page wants it; safe to ask from any thread."""

    def __init__(
        self,
        root: Path,
        page: str,
        further: Mapping[str, Any],
        held_out: HeldOut | None,
    ) -> None:
        """Read nothing yet.

        Args:
            root: the run folder or file.
            page: the HTML of the page.
            further: what the header of a file is to say besides.
            held_out: a view to show beside its truth, if there is one.
        """
        self._root, self._page, self._further = root, page, further
        self._held_out = held_out
        self._coding, self._drawing = threading.Lock(), threading.Lock()
        self._coded: tuple[tuple[float, int], bytes] | None = None
        self._drawn: tuple[str, bytes] | None = None

    def pages(self) -> Pages:
        """Return what a server answers."""
        return {
            "/": lambda: Answer("index.html", self._page.encode()),
            "/scene.dsplat": self._scene,
            "/state.json": lambda: document("state.json", self._state()),
            **(
                {"/drawn.png": self._drawn_png, "/truth.png": self._truth} if self._held_out else {}
            ),
        }

    def _scene(self) -> Answer | None:
        """Return the newest splats: of a snapshot, a checkpoint, or the file."""
        data = self._newest(open_run(self._root))
        return None if data is None else Answer("scene.dsplat", data, _version(data))

    def _newest(self, run: Run) -> bytes | None:
        if run.is_file:
            return bytes_of(self._root)
        snapshot, checkpoint = snapshots.snapshot_path(self._root), run.checkpoint_path
        if _changed(snapshot) > _changed(checkpoint):
            return bytes_of(snapshot)
        return self._of_checkpoint(checkpoint) if checkpoint.is_file() else None

    def _of_checkpoint(self, path: Path) -> bytes:
        """Return the file of the last checkpoint, which is coded once."""
        with self._coding:
            which = _changed(path), path.stat().st_size
            if self._coded is None or self._coded[0] != which:
                run, model, _ = open_with_model(self._root)
                facts = run.facts.frames, run.facts.bound
                self._coded = which, quick_file(model, *facts, self._further)
            return self._coded[1]

    def _state(self) -> dict[str, Any]:
        """Return how the training stands; somebody has asked, and so looks."""
        run = open_run(self._root)
        if not run.is_file:
            snapshots.mark(self._root)
        log = run.read_log()
        last: dict[str, Any] = log[-1] if log else {}
        progress, elapsed = float(last.get("progress", 1.0)), float(last.get("elapsed", 0.0))
        running = progress < 1 and time.time() - _changed(run.log_path) < QUIET
        return {
            "name": self._root.resolve().name,
            "preset": run.name,
            "running": running,
            "progress": progress,
            "elapsed": elapsed,
            "remaining": _time_left(run, elapsed, progress) if running else None,
            "step": last.get("step"),
            "splats": last.get("splats"),
            "curve": _curve(log),
            "scene": self._mark_of_scene(run),
            "held_out": self._held_out is not None,
        }

    def _mark_of_scene(self, run: Run) -> str:
        """Return what changes whenever there are newer splats."""
        newest = max(_changed(p) for p in (run.checkpoint_path, snapshots.snapshot_path(run.root)))
        return f"{newest:.6f}"

    def _truth(self) -> Answer | None:
        if self._held_out is None:
            return None
        data = self._held_out.truth()
        return Answer("truth.png", data, _version(data))

    def _drawn_png(self) -> Answer | None:
        """Return the held-out view of the newest splats, which is drawn once."""
        scene = self._newest(open_run(self._root))
        if scene is None or self._held_out is None:
            return None
        with self._drawing:
            version = _version(scene)
            if self._drawn is None or self._drawn[0] != version:
                try:
                    model = model_of(decoded(*from_bytes(scene)))
                except WRONG as error:
                    raise DataError(f"{self._root}: damaged: {error}") from error
                self._drawn = version, self._held_out.drawn(model)
            return Answer("drawn.png", self._drawn[1], version)


def _curve(log: list[dict[str, Any]]) -> list[list[float]]:
    """Return pairs of minutes and PSNR, evenly chosen; the last is always there."""
    points = [
        [entry["elapsed"] / 60, entry[name]]
        for entry in log
        for name in ("val_psnr", "train_psnr")
        if entry.get(name) is not None
    ]
    every = -(-len(points) // MOST_POINTS) or 1
    return points[::-1][::every][::-1]


def _changed(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _version(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=12).hexdigest()


def _time_left(run: Run, elapsed: float, progress: float) -> float:
    """Return the wall time that is left of a training [s]; moments of a stream have no power."""
    preset = run.preset
    power = 1.0 if preset.stream.enabled else preset.training.progress_power
    return time_left(elapsed, progress, power)
