"""Chooses which views a training may see yet: those about one moment first, then more and more.

What moves farther than its own size is a smear in the mean over all moments, and where it is seen
against a plain background it is worth nothing there: its splats turn transparent, and nothing is
left to learn a motion. In a short time about one moment it hardly moves. From there on it is
followed, as the window grows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from gsdmsr_cli.options.preset import TrainingOptions


class Window:
    """The views that are nearest to a moment, of which there are more and more.

    Args:
        times: of all train views, in [0, 1].
        options: see ``window``, ``window_until`` and ``window_at`` there.
    """

    def __init__(self, times: Sequence[float], options: TrainingOptions) -> None:
        self._options = options
        nearest = sorted(range(len(times)), key=lambda row: abs(times[row] - options.window_at))
        self._place = {row: place for place, row in enumerate(nearest)}

    def shows(self, row: int, progress: float) -> bool:
        """Return whether a view may be seen; there always is one at least that may."""
        return self._place[row] < self._count(progress)

    def _count(self, progress: float) -> int:
        first, until = self._options.window, self._options.window_until
        grown = min(1.0, progress / until) if until > 0 else 1.0
        return max(1, math.ceil((first + (1 - first) * grown) * len(self._place)))
