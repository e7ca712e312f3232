"""Times functions in turns, so that a busy machine disturbs all of them alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

ROUNDS = 9
SECONDS_A_TURN = 0.25


def in_turns(
    functions: Mapping[str, Callable[[], object]], rounds: int = ROUNDS
) -> dict[str, float]:
    """Return each function's milliseconds per call: the median over rounds of a turn's median.

    Every function runs twice first, which compiles it. In each round every function has a turn of
    about a quarter of a second.
    """
    calls: dict[str, int] = {}
    for name, function in functions.items():
        function()
        started = time.perf_counter()
        function()
        calls[name] = max(1, int(SECONDS_A_TURN / max(time.perf_counter() - started, 1e-6)))
    turns: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            turns[name].append(_median_call(function, calls[name]))
    return {name: 1e3 * statistics.median(times) for name, times in turns.items()}


def _median_call(function: Callable[[], object], calls: int) -> float:
    times = []
    for _ in range(calls):
        started = time.perf_counter()
        function()
        times.append(time.perf_counter() - started)
    return statistics.median(times)
