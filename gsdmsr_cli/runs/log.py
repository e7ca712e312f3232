"""The log of a training: a file to which reports are appended, one JSON object per line."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.runs.checkpoints import WRONG

_LONGEST = 1 << 20
"""Bytes from the end in which the end of the last whole line is looked for."""


def append(path: Path, entries: Sequence[Mapping[str, Any]]) -> None:
    """Append lines to a log, in place of one at its end whose writing was cut short.

    Raises:
        DataError: they cannot be written; what was in the log before is still there.
        ValueError: an entry holds NaN or infinity, which JSON does not have.
    """
    lines = "".join(json.dumps(entry, allow_nan=False) + "\n" for entry in entries).encode()
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        with os.fdopen(descriptor, "r+b", buffering=0) as file:
            length = file.seek(0, os.SEEK_END)
            start = file.seek(max(length - _LONGEST, 0))
            file.truncate(start + file.read().rfind(b"\n") + 1)
            file.seek(0, os.SEEK_END)
            while lines:
                lines = lines[file.write(lines) or 0 :]
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{path}: cannot be written: {reason}; is the disk full?") from error


def read(path: Path) -> list[dict[str, Any]]:
    """Return the entries of a log, without a last one that a killed training has cut short.

    Raises:
        DataError: the log cannot be read or is damaged.
    """
    if not path.is_file():
        return []
    try:
        *lines, _ = path.read_text(encoding="utf-8").split("\n")
        return [dict(json.loads(line)) for line in lines]
    except (OSError, *WRONG) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error


def rewind(path: Path, step: int) -> None:
    """Drop the lines of a log after ``step``, and one whose writing was interrupted.

    Raises:
        DataError: the log cannot be read or written.
    """
    if not path.is_file():
        return
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    with replacing(path) as beside:
        text = "".join(line for line in lines if _is_up_to(step, line))
        beside.write_text(text, encoding="utf-8")


def _is_up_to(step: int, line: str) -> bool:
    try:
        return bool(json.loads(line)["step"] <= step)
    except WRONG:
        return False
