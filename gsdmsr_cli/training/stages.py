"""What a training spends its time on."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

STAGES = ("look", "learn", "grow", "watch", "save")
"""Drawing, comparing and taking gradients; the optimiser's step; growing, pruning and letting stand
still; drawing the watched view; writing checkpoints."""


class Stopwatch:
    """Adds up wall time by stage, on the clock of the host."""

    def __init__(self) -> None:
        self._seconds = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Count the time of the block for a stage."""
        started = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[stage] += time.perf_counter() - started

    def take(self) -> dict[str, float]:
        """Return the seconds of every stage since the last call, or since the beginning."""
        taken = self._seconds
        self._seconds = dict.fromkeys(STAGES, 0.0)
        return taken
