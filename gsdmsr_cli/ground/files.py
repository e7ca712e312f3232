"""Files on disk that are whole or not there, and JSON documents."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError

_OURS = re.compile(r"\.gsdmsr-([0-9a-f]{16})[0-9a-f]{16}\.part(\.[^/]*)?")
"""Names of what is being written: a hash of the name that it is to get, and a random number."""

_REFUSALS = errno.EINVAL, errno.ENOTSUP, errno.EACCES, errno.EPERM
"""What drives answer that cannot flush a folder, or whose folders cannot be read."""

ANOTHER_OUT = "choose another --out or change the rights"
"""What to do where a folder of results cannot be written."""


@contextmanager
def replacing(path: Path, durable: bool = True) -> Iterator[Path]:
    """Yield a path beside ``path``, with its suffix, that takes its place if the block succeeds.

    So a file is whole or as it was, and has the rights that the umask gives. What a killed process
    has left behind is removed by ``remove_leftovers``.

    Args:
        path: the file.
        durable: whether it must be on the disk when the block is over, so that not even a loss of
            power takes it back. This costs a few milliseconds; a picture of a film may go without.

    Raises:
        DataError: the file cannot be written, or the block has raised OSError.
    """
    beside = _beside(path)
    try:
        yield beside
        if durable:
            _flush(beside)
        beside.replace(path)
        if durable:
            _flush(path.parent)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{path}: cannot be written: {reason}; is the disk full?") from error
    finally:
        with suppress(OSError):
            beside.unlink()


@contextmanager
def written_apart(path: Path) -> Iterator[Path]:
    """Yield a path in a folder of its own, beside ``path``, to which the file is moved in the end.

    For libraries that write to further files, or with other rights than those that the umask gives.
    """
    folder = _beside(path)
    folder.mkdir()
    try:
        (folder / "rights").touch()
        yield folder / path.name
        (folder / path.name).chmod((folder / "rights").stat().st_mode)
        (folder / path.name).replace(path)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _beside(path: Path) -> Path:
    """Return a path for what is to become ``path``; its length does not depend on that name's."""
    number = _hash_of(path.name) + secrets.token_hex(8)
    return path.with_name(f".gsdmsr-{number}.part{path.suffix}")


def _hash_of(name: str) -> str:
    return hashlib.sha256(os.fsencode(name)).hexdigest()[:16]


def _flush(path: Path) -> None:
    """Have a file, or the names in a folder, written to the disk."""
    folder = path.is_dir()
    if folder and sys.platform == "win32":
        return  # folders cannot be opened there
    try:
        descriptor = os.open(path, os.O_RDONLY if folder else os.O_RDWR)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if not folder or error.errno not in _REFUSALS:
            raise


def leftovers(folder: Path, name: str | None = None) -> list[Path]:
    """Return what killed processes have left unfinished in ``folder``, nobody else's files.

    Args:
        folder: where nobody is writing now.
        name: of the file that was being written; all if None.
    """
    found = [(path, _OURS.fullmatch(path.name)) for path in folder.iterdir()]
    return [
        path
        for path, match in found
        if match is not None and (name is None or match[1] == _hash_of(name))
    ]


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes have left unfinished in ``folder``; see ``leftovers``.

    Raises:
        OSError: something cannot be removed.
    """
    for left in leftovers(folder, name):
        if left.is_dir() and not left.is_symlink():
            shutil.rmtree(left)
        else:
            left.unlink()


def remove_if_empty(folder: Path) -> None:
    """Remove a folder unless there is something in it.

    Raises:
        OSError: it cannot be removed for another reason.
    """
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


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


def require_folder(path: Path, remedy: str = ANOTHER_OUT) -> None:
    """Make the folder ``path`` unless it is there, so that work for it is not done in vain.

    Args:
        path: the folder.
        remedy: what to do where it cannot be written.

    Raises:
        DataError: it cannot be made, or nothing can be written there.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{path}: cannot be made: {reason}; {remedy}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise DataError(f"{path}: cannot be written; {remedy}")


def can_be_written(folder: Path) -> bool:
    """Return whether the folder, or the nearest one above it that is there, takes files."""
    place = nearest_there(folder)
    return place.is_dir() and os.access(place, os.W_OK | os.X_OK)


def nearest_there(path: Path) -> Path:
    """Return the path, or the nearest one above it that is there, absolute."""
    whole = path.absolute()
    return next(place for place in (whole, *whole.parents) if os.access(place, os.F_OK))


def read_json(path: Path) -> dict[str, Any]:
    """Return the object that ``path`` holds.

    Raises:
        DataError: the file cannot be read or is not a JSON object.
    """
    try:
        text = path.read_text(encoding="utf-8")
        document = json.loads(text, parse_constant=_refuse_constant)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise DataError(f"{path}: damaged: {error}") from error
    except RecursionError as error:
        raise DataError(f"{path}: damaged: its lists or objects are nested too deeply") from error
    if not isinstance(document, dict):
        raise DataError(f"{path}: damaged: it holds no JSON object")
    return document


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number that JSON has")
