"""Durations as users write them: "90s", "8m", "1.5h"."""

from __future__ import annotations

import math
import re

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.strict import require

_SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0}
_ALLOWED = "a positive duration such as 90s, 8m or 1.5h"


def parse_duration(text: str) -> float:
    """Return the seconds of "90s", "8m", "2.5m" or "1h".

    Raises:
        UsageError: the text is not a positive duration.
    """
    seconds = _duration(text)
    if seconds is None:
        raise UsageError(f"'{text}' is not a duration; allowed: {_ALLOWED}")
    return seconds


def require_duration(options: object, key: str) -> None:
    """Check that a field is a duration, or None.

    Raises:
        InvalidError: it is not.
    """
    text = getattr(options, key)
    require(options, key, text is None or _duration(text) is not None, f"null or {_ALLOWED}")


def _duration(text: str) -> float | None:
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    seconds = float(match[1]) * _SECONDS[match[2]] if match else 0.0
    return seconds if 0.0 < seconds < math.inf else None
