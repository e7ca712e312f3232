"""Locks of folders, by which commands that run at once stay out of each other's way.

A command holds what it writes alone and what it reads together with other readers, from before
its first look until its end. The end of the process, however it comes, lets go; what it forks holds
nothing. Where folders cannot be locked, on Windows and on some network drives, nobody is kept out.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import ANOTHER_OUT, require_folder

if sys.platform != "win32":
    import fcntl

    _ALONE, _SHARED, _AT_ONCE = fcntl.LOCK_EX, fcntl.LOCK_SH, fcntl.LOCK_NB
else:
    _ALONE = _SHARED = _AT_ONCE = 0

_held = set[int]()
"""Descriptors by which this process holds folders."""


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Keep other processes that write or read there out of the folder ``folder``, which is made.

    Raises:
        DataError: another process writes or reads there, or the folder cannot be made.
    """
    with _holding(folder, _ALONE | _AT_ONCE, make=True):
        yield


@contextmanager
def one_of_readers(folder: Path) -> Iterator[None]:
    """Keep processes that would write there out of the folder ``folder``, but no other readers.

    A folder that is not there is not held: whoever reads it will say what is wrong with it.

    Raises:
        DataError: another process is writing there.
    """
    with _holding(folder, _SHARED | _AT_ONCE, make=False):
        yield


@contextmanager
def in_turn(folder: Path, remedy: str = ANOTHER_OUT) -> Iterator[None]:
    """Wait until no other process is here with the folder ``folder``, which is made.

    Args:
        folder: the folder.
        remedy: what to do where it cannot be made.

    Raises:
        DataError: the folder cannot be made.
    """
    require_folder(folder, remedy)
    with _holding(folder, _ALONE, make=True):
        yield


@contextmanager
def _holding(folder: Path, kind: int, make: bool) -> Iterator[None]:
    descriptor = _lock(folder, kind, make)
    try:
        yield
    finally:
        if descriptor in _held:
            _held.remove(descriptor)
            os.close(descriptor)


def _lock(folder: Path, kind: int, make: bool) -> int:
    """Return the descriptor that holds the folder, or -1 where it cannot be locked."""
    if make:
        require_folder(folder)
    try:
        descriptor = -1 if sys.platform == "win32" else os.open(folder, os.O_RDONLY)
    except OSError:
        return -1
    try:
        held = _take(folder, descriptor, kind)
        moved = held and not _is_at(folder, descriptor)
    except BaseException:  # a refusal, or Ctrl-C while waiting
        os.close(descriptor)
        raise
    if held and not moved:
        _held.add(descriptor)
        return descriptor
    if descriptor >= 0:
        os.close(descriptor)
    return _lock(folder, kind, make) if moved else -1


def _take(folder: Path, descriptor: int, kind: int) -> bool:
    """Return whether the descriptor holds its folder now; False where folders cannot be locked.

    Raises:
        DataError: another process holds it.
    """
    if sys.platform == "win32":
        return False
    try:
        fcntl.flock(descriptor, kind)
    except BlockingIOError:
        readers = bool(kind & _ALONE) and _take_shared(descriptor)
        doing, remedy = ("reading" if readers else "writing"), " or choose another --out"
        raise DataError(
            f"{folder}: another process is {doing} there; wait for its end"
            f"{remedy if kind & _ALONE else ''}"
        ) from None
    except OSError:
        return False
    return True


def _take_shared(descriptor: int) -> bool:
    if sys.platform != "win32":
        try:
            fcntl.flock(descriptor, _SHARED | _AT_ONCE)
        except OSError:
            return False
    return True


def _is_at(folder: Path, descriptor: int) -> bool:
    """Return whether the folder that is held is still what is called ``folder``."""
    try:
        return os.path.samestat(folder.stat(), os.fstat(descriptor))
    except OSError:
        return False


def _let_go() -> None:
    while _held:
        os.close(_held.pop())


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_let_go)  # or forks would keep the lock after a kill
