"""How functions that take long say how far they have come."""

from __future__ import annotations

import math
from collections.abc import Callable

OnProgress = Callable[[int, int], None]
"""Called with how much is done, and of how much."""


def time_left(elapsed: float, progress: float, power: float) -> float:
    """Return the wall time that is left of a training [s].

    Args:
        elapsed: wall time so far [s].
        progress: in [0, 1].
        power: of the share of the time that progress is.
    """
    share = math.pow(progress, 1 / power)
    return elapsed * (1 - share) / max(share, 1e-9)
