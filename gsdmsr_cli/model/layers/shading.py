"""Brightness that changes in time, as shadows move and what is near throws other light.

A motion moves splats, and a splat keeps its colours. Where a shadow falls, or an arm comes near a
side, a true picture does not. What is left then is learnt as if it came from the direction of the
one view that saw that moment, by harmonics, and is wrong from every other. Here each splat of
colour c is drawn in c + g c, with g a number of its own at times that are evenly spaced and
straight lines between them. It is learnt late: from the beginning on splats would change their
brightness where they ought to move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.hats import hats
from gsdmsr_cli.options.strict import require, require_progress, require_rates


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        nodes: number of times from the first to the last, 2 or more.
        since: progress from which on it is learnt.
        rate: learning rate of the numbers at the start and the end.
    """

    nodes: int = 8
    since: float = 0.5
    rate: tuple[float, float] = (5e-4, 2e-4)

    def __post_init__(self) -> None:
        require(self, "nodes", self.nodes >= 2, "2 or more")
        require_progress(self, "since")
        require_rates(self, "rate")


class Shading(Layer):
    """Shares of the colours by which splats are brighter (N, K) at times from 0 to 1.

    Attributes:
        learning: whether it is learnt yet; before it changes nothing.
    """

    constants = ("learning",)

    def __init__(self, options: Options, count: int) -> None:
        self.options = options
        self.learning = True
        self.gains = torch.zeros(count, options.nodes)
        super().__init__([Parameter("gains", self.gains, True, options.rate, time_axis=1)])

    def advance(self, progress: float) -> None:
        """Begin to learn at ``since``."""
        self.learning = progress >= self.options.since

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats as bright as they are at the instant."""
        return self.at_moments([moment], [instant])[0]

    def at_moments(self, moments: Sequence[Moment], instants: Sequence[Instant]) -> list[Moment]:
        """Return the splats of each moment as bright as they are at its instant."""
        if not self.learning:
            return list(moments)
        times, nodes = [instant.time for instant in instants], self.gains.shape[1]
        shares = hats(times, self.gains.new_empty(nodes))
        return [
            _brighter(moment, gains)
            for moment, gains in zip(moments, (self.gains @ shares.T).unbind(1), strict=True)
        ]

    def check(self) -> None:
        """Raise ValueError unless there are numbers for two times or more."""
        if self.gains.shape[1] < 2:
            raise ValueError(f"gains of shape {tuple(self.gains.shape)}")


def _brighter(moment: Moment, gains: Tensor) -> Moment:
    """Return the splats, of colour c, in the colour c + gains c, with gains (N,)."""
    sh, by = moment.splats.sh, gains[:, None, None]
    brighter = sh * (1 + by)
    brighter[:, 0] += by[:, 0] / (2 * SH_C0)  # colours are 1/2 + C0 sh[:, 0] + ...
    return replace(moment, splats=replace(moment.splats, sh=brighter))


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Shading:
    """Return a layer that changes nothing until it has been trained."""
    return Shading(options, len(splats))
