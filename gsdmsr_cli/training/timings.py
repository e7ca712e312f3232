"""Measures what the wall time of a training goes into."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

TIMINGS = ("gradients", "optimizer", "population", "validation", "save")
"""Drawing, comparing and taking gradients; the optimiser's step; the events that change the splats;
drawing the validation view; writing checkpoints."""

_BEFORE = {
    "look": "gradients", "learn": "optimizer", "grow": "population", "watch": "validation",
}  # fmt: skip
"""Names that timings had before version 0.2, in logs under "stages"."""


class Stopwatch:
    """Adds up wall time by name, on the clock of the host."""

    def __init__(self) -> None:
        self._seconds = dict.fromkeys(TIMINGS, 0.0)

    @contextmanager
    def of(self, name: str) -> Iterator[None]:
        """Add the time of the block to that of a name of ``TIMINGS``."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] += time.perf_counter() - started

    def take(self) -> dict[str, float]:
        """Return the seconds by name since the last call, or since the beginning."""
        taken = self._seconds
        self._seconds = dict.fromkeys(TIMINGS, 0.0)
        return taken


def timings_of(entry: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Return the seconds by name of an entry of a log, of this version or of an earlier one."""
    seconds = entry.get("timings", entry.get("stages", {}))
    return {_BEFORE.get(name, name): spent for name, spent in seconds.items()}
