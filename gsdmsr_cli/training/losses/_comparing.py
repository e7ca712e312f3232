"""What terms share that compare two times: their schedule, and which second time they choose."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.finite import finite_rows
from gsdmsr_cli.options.strict import require, require_progress
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses import Seen, Term


@dataclass(frozen=True)
class Schedule:
    """Settings of every term that compares two times, and of others that end.

    Attributes:
        factor: weight of the term, above 0.
        until: progress up to which it counts.
        every: in every how many-th step it counts, with as many times the factor.
    """

    factor: float = 0.01
    until: float = 1.0
    every: int = 1

    def __post_init__(self) -> None:
        require(self, "factor", self.factor > 0, "a number above 0")
        require_progress(self, "until")
        require(self, "every", self.every >= 1, "1 or more")

    def weight(self, progress: float) -> float:
        """Return the factor until the term ends, then 0."""
        return self.factor if progress < self.until else 0.0


class ComparingTerm(Term):
    """A term that is 0 where there is no second time, as in a scene of one moment."""

    def __init__(self, schedule: Schedule) -> None:
        self.schedule, self.every = schedule, schedule.every

    def weight(self, progress: float) -> float:
        """Return the factor until the term ends, then 0."""
        return self.schedule.weight(progress)

    def other_time(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> float | None:
        """Return the train time before or after, whichever chance says, or the only one there."""
        return adjacent_time(view.time, times, generator)


def adjacent_time(time: float, times: Sequence[float], generator: torch.Generator) -> float | None:
    """Return one of the times next to ``time`` in ``times``, which ascend; None without any."""
    at = bisect_left(times, time)
    beside = [*times[max(at - 1, 0) : at], *[other for other in times[at : at + 2] if other > time]]
    return _one_of(beside[:2], generator)


def any_time(time: float, times: Sequence[float], generator: torch.Generator) -> float | None:
    """Return one of the times other than ``time``, or None without any."""
    return _one_of([other for other in times if other != time], generator)


def first_time(time: float, times: Sequence[float]) -> float | None:
    """Return the first of the times, or None if that is ``time``."""
    return times[0] if times and times[0] != time else None


@torch.no_grad()
def finite_rows_of(now: Splats, other: Splats) -> Tensor:
    """Return the rows (M,) of the splats whose places, rotations and scales are finite in both."""
    tensors = [t for s in (now, other) for t in (s.means, s.quats, s.log_scales)]
    return finite_rows(tensors, len(now)).nonzero().flatten()


def nothing(seen: Seen) -> Tensor:
    """Return 0 () of the type and on the device of what was drawn."""
    return seen.moment.splats.means.new_zeros(())


def _one_of(times: Sequence[float], generator: torch.Generator) -> float | None:
    if not times:
        return None
    return times[int(torch.randint(len(times), (), generator=generator))]
