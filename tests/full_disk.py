"""A disk that is full at one of the changes that a test makes, whichever it wants."""

from __future__ import annotations

import errno
import itertools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class _Disk:
    """Counts what Python tells of before it is done below a folder, and lets one of it fail."""

    def __init__(self) -> None:
        self.root, self.left = "", 0
        sys.addaudithook(self._watch)

    def _watch(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.root or not str(arguments[:1]).count(self.root):
            return
        path = str(arguments[0])
        opened = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        made = event == "os.mkdir" and not Path(path).is_dir()
        if opened or made or event == "os.rename":
            self.left -= 1
            if self.left == 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)

    @contextmanager
    def full_at(self, number: int, root: Path) -> Iterator[None]:
        self.root, self.left = str(root), number
        try:
            yield
        finally:
            self.root = ""


_disk = _Disk()  # once, since what watches cannot be taken back


def full_at_every_change(place: Path, least: int, every: int = 1) -> Iterator[tuple[Path, Any]]:
    """Yield a new folder, and a block in which a change there fails, a later one each time.

    In the last block nothing is left that could fail. ``every`` says how much later; ``least`` is
    how many changes there must have been, lest nothing be tried.
    """
    for number in itertools.count(1, every):
        folder = place / f"{number:04d}"
        folder.mkdir(parents=True)
        yield folder, _disk.full_at(number, folder)
        if _disk.left > 0:
            assert number > least
            return


def has_failed() -> bool:
    """Return whether the change that was to fail in the last block has been tried."""
    return _disk.left <= 0
