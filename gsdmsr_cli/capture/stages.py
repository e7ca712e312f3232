"""Keeps finished stages of work in folders, so that a second run continues after them."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError

_DIGITS = 16


class Stages:
    """The finished stages in a folder of their own.

    Args:
        root: the folder; made when the first stage begins.
    """

    def __init__(self, root: Path) -> None:
        self.root = root

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
        """Delete all stages."""
        shutil.rmtree(self.root, ignore_errors=True)


def digest(key: Mapping[str, Any]) -> str:
    """Return a short hash of what fits into JSON."""
    text = json.dumps(key, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:_DIGITS]
