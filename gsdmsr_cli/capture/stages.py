"""Keeps finished stages of work in folders, so that a second run continues after them."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsdmsr_cli.capture.marked import MARKER, is_marked, mark, remove, remove_marker
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import leftovers
from gsdmsr_cli.ground.locks import sole_writer

_DIGITS = 16
_STAGE = re.compile(rf"[a-z]+-[0-9a-f]{{{_DIGITS}}}|\.[a-z]+\.part")
"""Names of the folders of stages, finished and not."""

NOTE = "publishing.json"
"""File for what is going to become of the last stage, see ``capture.publish``."""


class Stages:
    """The finished stages in a folder of their own.

    Args:
        root: the folder; made when the first stage begins.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

    @contextmanager
    def held(self) -> Iterator[None]:
        """Make the folder, or take over an earlier one, and keep other processes from it.

        At the end a folder without any stage is gone.

        Raises:
            DataError: another process works there, the folder is not one of stages, or it cannot be
                written.
        """
        with sole_writer(self.root):
            self._take_over()
            try:
                yield
            finally:
                with suppress(OSError):
                    remove_marker(self.root)

    def _take_over(self) -> None:
        """Mark the folder, which earlier versions did not."""
        foreign = [entry for entry in self.root.iterdir() if not _STAGE.fullmatch(entry.name)]
        if foreign and not is_marked(self.root):
            raise DataError(
                f"{self.root}: is where prepare keeps its stages, but holds {min(foreign).name}, "
                "which is not of prepare; move the folder away or choose another --out"
            )
        try:
            mark(self.root)
        except OSError as error:
            reason = error.strerror or error
            raise DataError(f"{self.root}: cannot be written: {reason}; free space") from error

    def run(self, name: str, key: Mapping[str, Any], make: Callable[[Path], None]) -> Path:
        """Return the stage's folder, filled by ``make`` unless it is there already.

        Args:
            name: of the stage.
            key: all that its content depends on, fit for JSON.
            make: fills an empty folder; if it raises, or the process ends, there is no stage.

        Raises:
            DataError: the disk is full or cannot be written.
        """
        folder = self.root / f"{name}-{digest(key)}"
        if folder.is_dir():
            return folder
        part = self.root / f".{name}.part"
        try:
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir(parents=True)
            make(part)
            part.rename(folder)
        except OSError as error:
            where = error.filename or part
            raise DataError(
                f"{where}: cannot be written: {error.strerror or error}; free space or choose "
                "another --out; what is finished is kept"
            ) from error
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return folder

    def remove(self) -> None:
        """Delete all stages, but nothing that somebody else has put there."""
        stages = [entry for entry in self.root.iterdir() if _STAGE.fullmatch(entry.name)]
        for entry in (*stages, *leftovers(self.root), self.root / NOTE):
            remove(entry)
        if not any(entry.name != MARKER for entry in self.root.iterdir()):
            with suppress(OSError):
                (self.root / MARKER).unlink(missing_ok=True)
                self.root.rmdir()


def digest(key: Mapping[str, Any]) -> str:
    """Return a short hash of what fits into JSON."""
    text = json.dumps(key, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]
