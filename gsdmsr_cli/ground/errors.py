"""The errors a user can cause, each with the exit code it ends in."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from gsdmsr_cli.ground.printing import one_line

LONGEST = 2000
"""Characters of a message; what a file holds may be longer than anybody reads."""


class GsdmsrError(Exception):
    """An error whose message is one line: what was found, what is allowed and what to do."""

    exit_code = 1

    def __str__(self) -> str:
        text = one_line(super().__str__())
        return text if len(text) <= LONGEST else f"{text[: LONGEST - 500]} ... {text[-400:]}"


class UsageError(GsdmsrError):
    """The command line or a preset asks for something that does not exist."""

    exit_code = 2


class DataError(GsdmsrError):
    """A file or folder given as input cannot be used."""

    exit_code = 3


class ThresholdError(GsdmsrError):
    """A measured value misses a threshold, or is worse than a baseline allows."""

    exit_code = 4


def nearest(word: str, known: Iterable[str]) -> str:
    """Return a clause naming the known word closest to ``word``, or all if none is close."""
    known = sorted(known)
    close = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(known) or 'none'}"
