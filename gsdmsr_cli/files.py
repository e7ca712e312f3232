"""JSON documents on disk that are whole or not there."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsdmsr_cli.errors import DataError


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Replace ``path`` by the document, strict JSON; its folder is made.

    Raises:
        DataError: the file cannot be written.
        ValueError: the document holds NaN or infinity, which JSON does not have.
    """
    text = json.dumps(document, indent=2, allow_nan=False) + "\n"
    beside = path.with_name(f"{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            beside.unlink()
        reason = error.strerror or error
        raise DataError(f"{path}: cannot be written: {reason}; is the disk full?") from error


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
