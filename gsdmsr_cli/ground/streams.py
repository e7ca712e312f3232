"""Standard output and error whose failing ends no work: it is remembered and told at the end.

The reader of a log may leave before a training is over, the disk behind it may be full, and the
terminal may be closed. What cannot be written then is dropped, and later lines are tried again.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class _Outlet(io.FileIO):
    """A descriptor that takes whatever is written to it; ``error`` is the first that came of it."""

    error: OSError | None = None

    def write(self, data: ReadableBuffer, /) -> int:
        """Write all of ``data``, or drop the rest of it."""
        rest = memoryview(data).cast("B")
        count = len(rest)
        try:
            while rest:
                rest = rest[super().write(rest) or len(rest) :]
        except OSError as error:
            self.error = self.error or error
        return count


@contextmanager
def unfailing() -> Iterator[Callable[[], str | None]]:
    """Replace ``sys.stdout`` and ``sys.stderr`` in the block; yield what tells of lost output.

    Called, it returns why something that was printed to ``sys.stdout`` has been lost; None if
    nothing has been, or its reader has left. Streams that somebody else has put there stay, and so
    does a console of Windows, which takes no bytes.
    """
    _occupy_standard_descriptors()
    before = sys.stdout, sys.stderr
    sys.stdout, output = _unfailing(sys.stdout, sys.__stdout__)
    sys.stderr, _ = _unfailing(sys.stderr, sys.__stderr__)

    def lost() -> str | None:
        _flush()
        error = None if output is None else output.error
        if error is None or isinstance(error, BrokenPipeError):
            return None
        return error.strerror or str(error)

    try:
        yield lost
    finally:
        _flush()
        sys.stdout, sys.stderr = before


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # as where there is no terminal at all
            stream.flush()


def _unfailing(stream: TextIO, own: TextIO | None) -> tuple[TextIO, _Outlet | None]:
    console = sys.platform == "win32" and stream is not None and stream.isatty()
    if stream is None or stream is not own or console:
        return stream, None
    stream.flush()
    outlet = _Outlet(stream.fileno(), "wb", closefd=False)
    wrapped = io.TextIOWrapper(
        io.BufferedWriter(outlet),
        encoding=stream.encoding,
        errors="backslashreplace",  # a character that the terminal has not must not end work either
        line_buffering=True,
    )
    return wrapped, outlet


def _occupy_standard_descriptors() -> None:
    """Let no file that is opened later take the number of a standard stream that is closed.

    Libraries would write their messages into it.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, which is this one
