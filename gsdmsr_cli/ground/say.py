"""Prints the results of commands on stdout, and what they have to say meanwhile on stderr.

The options that all commands have, ``--json``, ``--quiet``, ``--verbose`` and ``--log-file``, are
heeded here and nowhere else.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.printing import printable

if TYPE_CHECKING:
    from rich.console import RenderableType

WARNINGS, NOTES, DETAILS = 0, 1, 2
"""How much is said on stderr: warnings and errors alone, notes and progress, or details too."""


@dataclass
class _Manner:
    """How the command that runs now is to speak.

    Attributes:
        as_json: print one line of JSON as the result, and nothing else on stdout.
        level: how much is said on stderr.
        log: where that is written as well, with times.
        answered: whether the JSON object has been printed.
        parts: results of commands within another one, which are not printed; None where the
            command is on its own.
    """

    as_json: bool = False
    level: int = NOTES
    log: TextIO | None = None
    answered: bool = False
    parts: list[Mapping[str, Any]] | None = field(default=None)


_manner = _Manner()


@contextmanager
def on_its_own(as_json: bool = False) -> Iterator[None]:
    """Forget at the end of the block what has been asked for in it."""
    global _manner
    before, _manner = _manner, _Manner(as_json)
    try:
        yield
    finally:
        if _manner.log is not None:
            _manner.log.close()
        _manner = before


def answer_in_json() -> None:
    """Print results as JSON from now on."""
    _manner.as_json = True


def wants_json() -> bool:
    """Return whether results are printed as JSON."""
    return _manner.as_json


def speak_up_to(level: int) -> None:
    """Say ``WARNINGS``, ``NOTES`` or ``DETAILS`` on stderr from now on."""
    _manner.level = level


def shows_progress() -> bool:
    """Return whether bars and lines of progress are wanted."""
    return _manner.level >= NOTES


def log_to(path: Path) -> None:
    """Append what is said on stderr to a file too, each line with its time.

    Raises:
        UsageError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _manner.log = path.open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        reason = error.strerror or error
        raise UsageError(f"--log-file {path}: cannot be written: {reason}") from error


def error(text: str) -> None:
    """Say what has ended the command, even where quiet is wanted."""
    _say(f"error: {text}", WARNINGS)


def warn(text: str) -> None:
    """Say what nobody must miss, even where quiet is wanted."""
    _say(f"warning: {text}", WARNINGS)


def note(text: str) -> None:
    """Say a line on stderr."""
    _say(text, NOTES)


def detail(text: str) -> None:
    """Say a line on stderr where ``--verbose`` wants it."""
    _say(text, DETAILS)


def _say(text: str, level: int) -> None:
    text = printable(text)
    if level <= _manner.level:
        print(text, file=sys.stderr, flush=True)
    if level <= max(_manner.level, NOTES):
        write_log(text)


def write_log(text: str) -> None:
    """Append a line to the file of ``--log-file``, if there is one; a full disk ends that."""
    if _manner.log is None:
        return
    try:
        print(f"{datetime.now().astimezone().isoformat(timespec='milliseconds')} {text}",
              file=_manner.log, flush=True)  # fmt: skip
    except OSError as refused:
        _manner.log = None
        warn(f"--log-file cannot be written: {refused.strerror}")


def result(document: Mapping[str, Any], *shown: RenderableType, width: int | None = None) -> None:
    """Print what a command has to answer.

    Args:
        document: plain JSON; all that is printed where JSON is wanted.
        shown: lines and tables of the same for people, printed elsewhere.
        width: columns of text that tables may take, if not those of the terminal.
    """
    if _manner.parts is not None:
        _manner.parts.append(document)
    elif _manner.as_json:
        print(json.dumps(document, allow_nan=False), flush=True)
        _manner.answered = True
    if _manner.as_json:
        return
    from rich.console import Console  # which takes as long as the rest of --help

    console = Console(width=width)
    for part in shown:
        if isinstance(part, str):
            console.out("\n".join(map(printable, part.split("\n"))), highlight=False)
        else:
            console.print(part)


@contextmanager
def parts() -> Iterator[list[Mapping[str, Any]]]:
    """Yield the list of the documents that commands called in the block answer with.

    Where JSON is wanted they are not printed: the command that calls others prints them as one.
    """
    before, _manner.parts = _manner.parts, []
    try:
        yield _manner.parts
    finally:
        _manner.parts = before


def answer_with_error(kind: str, message: str, code: int) -> None:
    """Print an error as the result where JSON is wanted, unless there is one already."""
    if _manner.as_json and not _manner.answered:
        _manner.parts = None
        result({"error": {"kind": kind, "message": message, "exit_code": code}})
