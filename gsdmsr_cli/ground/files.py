"""Files on disk that are whole or not there, and JSON documents."""

from __future__ import annotations

import json
import os
import sys
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError

if sys.platform != "win32":
    import fcntl

_PART = ".part"

_held = set[int]()
"""Descriptors of the folders that this process is the sole writer of."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path beside ``path``, with its suffix, that takes its place if the block succeeds.

    So a file is whole or as it was. What a killed process has left behind is found by
    ``leftovers``.

    Raises:
        DataError: the file cannot be written, or the block has raised OSError.
    """
    beside = path.with_name(f".{path.stem}.{uuid.uuid4().hex}{_PART}{path.suffix}")
    try:
        yield beside
        beside.replace(path)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{path}: cannot be written: {reason}; is the disk full?") from error
    finally:
        with suppress(OSError):
            beside.unlink()


def leftovers(folder: Path) -> list[Path]:
    """Return the unfinished files in ``folder``, ours and those of safetensors."""
    return [*folder.glob(f".*{_PART}*"), *folder.glob(".tmp*")]


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Replace ``path`` by the document, strict JSON; its folder is made.

    Raises:
        DataError: the file cannot be written.
        ValueError: the document holds NaN or infinity, which JSON does not have.
    """
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by the text; its folder is made.

    Raises:
        DataError: the file cannot be written.
    """
    with replacing(path) as beside:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text, encoding="utf-8")


def require_folder(path: Path) -> None:
    """Make the folder ``path`` unless it is there, so that work for it is not done in vain.

    Raises:
        DataError: it cannot be made, or nothing can be written there.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot be made: {error.strerror or error}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise DataError(f"{path}: cannot be written; choose another folder or change its rights")


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Keep other processes that ask for the same from the folder ``folder``, which is made.

    The end of this process, however it comes, lets go of it; what it forks does not hold it. Where
    folders cannot be locked, on Windows and on some network drives, nobody is kept out.

    Raises:
        DataError: another process is the folder's writer, or it cannot be made.
    """
    require_folder(folder)
    descriptor = _lock(folder)
    try:
        yield
    finally:
        if descriptor in _held:
            _held.remove(descriptor)
            os.close(descriptor)


def _lock(folder: Path) -> int:
    """Return the descriptor that holds the folder, or -1 where folders cannot be locked."""
    if sys.platform == "win32":
        return -1
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise DataError(
            f"{folder}: another process is writing there; wait for its end or choose another --out"
        ) from None
    except OSError:
        os.close(descriptor)
        return -1
    _held.add(descriptor)
    return descriptor


def _let_go() -> None:
    while _held:
        os.close(_held.pop())


if sys.platform != "win32":
    os.register_at_fork(after_in_child=_let_go)  # or forks would keep the lock after a kill


def read_json(path: Path) -> dict[str, Any]:
    """Return the object that ``path`` holds.

    Raises:
        DataError: the file cannot be read or is not a JSON object.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise DataError(f"{path}: damaged: {error}") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: damaged: it holds no JSON object")
    return document
