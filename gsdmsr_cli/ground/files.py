"""Files on disk that are whole or not there, and JSON documents."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError

_PART = ".part"


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
