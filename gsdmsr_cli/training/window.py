"""Chooses which views a training may see yet: those about one moment first, then more and more.

What moves farther than its own size is a smear in the mean over all moments, and where it is seen
against a plain background it is worth nothing there: its splats turn transparent, and nothing is
left to learn a motion. In a short time about one moment it hardly moves. From there on it is
followed, as the window grows: times that no view has shown yet are held at the nearest one that has
been, so that what comes next is near where it is looked for. The more views there are, the rarer
each of the last comes; where they come no oftener than others, the window runs away from what it
is to follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.options.preset import TrainingOptions
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.starting.apart import views_with_things_apart

NEWEST = 0.1
"""Share of all views that count as those that have come last."""

FEW = 0.05
"""Share of the views that may show something apart by chance."""


class Window:
    """The views that are nearest to a moment, of which there are more and more.

    Where all views show the same moment, all are seen: none is nearer to another one.

    Args:
        times: of all train views, in [0, 1].
        options: see those there that begin with ``window``, but for ``window_if``.

    Attributes:
        note: why not all views are seen from the start, to be said to who trains, if so.
    """

    note: str | None = None

    def __init__(self, times: Sequence[float], options: TrainingOptions) -> None:
        self._options = options if len(set(times)) > 1 else replace(options, window=1.0)
        nearest = sorted(range(len(times)), key=lambda row: abs(times[row] - options.window_at))
        self._nearest = nearest
        self._place = {row: place for place, row in enumerate(nearest)}
        self._times = [times[row] for row in nearest]

    def shows(self, row: int, progress: float) -> bool:
        """Return whether a view may be seen; there always is one at least that may."""
        return self._place[row] < self._count(progress)

    def draw_newest(self, progress: float, generator: torch.Generator) -> int | None:
        """Return one of the views that have come last, or None if any may be next.

        While the window grows it is the former with the probability ``window_newest``.
        """
        share, count = self._options.window_newest, self._count(progress)
        if not share or count == len(self._nearest):
            return None
        if float(torch.rand((), generator=generator)) >= share:
            return None
        last = min(math.ceil(NEWEST * len(self._nearest)), count)
        return self._nearest[count - 1 - int(torch.randint(last, (), generator=generator))]

    def extent(self, progress: float) -> tuple[float, float] | None:
        """Return the first and the last time that may be seen, or None if all may."""
        count = self._count(progress)
        if count == len(self._times):
            return None
        return min(self._times[:count]), max(self._times[:count])

    def _count(self, progress: float) -> int:
        first, until = self._options.window, self._options.window_until
        since = min(self._options.static_until, until)  # what stands still cannot follow
        grown = (progress - since) / (until - since) if until > since else progress >= until
        grown = min(1.0, max(0.0, grown))
        return max(1, math.ceil((first + (1 - first) * grown) * len(self._place)))


def start_window(
    scene: Scene, pictures: Pictures, background: Tensor, options: TrainingOptions
) -> Window:
    """Return the window that the options want for the train views of a scene.

    Args:
        scene: gives views and box.
        pictures: the train pictures, composited on ``background`` (3,).
    """
    times = [view.time for view in scene.split("train")]
    window = Window(times, options)
    if window.extent(0.0) is None or options.window_if == "always":
        return window
    share = views_with_things_apart(scene, pictures, background)
    if share <= FEW:
        return Window(times, replace(options, window=1.0))
    window.note = (
        f"in {share:.0%} of the train views something lies apart from all that stands: those about "
        f"time {options.window_at:g} are seen first (training.window)"
    )
    return window
