"""Every splat is there between two times of its own, and fades before the first and after the last.

The temporal opacity of the dynamic splats of Ex4DGS (Lee et al., NeurIPS 2024): two Gaussians, of
which one says how a splat appears and one how it vanishes, and 1 between their centres. Splats that
stand still are there all the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.fading import fade
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.model.times import inverse_durations
from gsdmsr_cli.options.strict import require, require_rates

START, END = 0.1, 0.9
"""Where the centres begin: inside the capture, so that there is something that moves them."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        duration: of appearing and of vanishing, that splats begin with; above 0 [durations of the
            capture].
        centre_rate: learning rate of the two times at the start and the end.
        duration_rate: that of the logarithms of both durations.
    """

    duration: float = 1.0
    centre_rate: tuple[float, float] = (3e-3, 3e-4)
    duration_rate: tuple[float, float] = (3e-2, 3e-3)

    def __post_init__(self) -> None:
        require(self, "duration", self.duration > 0, "above 0")
        require_rates(self, "centre_rate", "duration_rate")


class LifeSpan(Layer):
    """Two times (N,) of each splat, and logarithms of how long it appears and vanishes (N,)."""

    identity_at_start = False

    def __init__(self, options: Options, count: int) -> None:
        log_duration = math.log(options.duration)
        self.starts, self.ends = torch.full((count,), START), torch.full((count,), END)
        self.log_appearing = torch.full((count,), log_duration)
        self.log_vanishing = torch.full((count,), log_duration)
        centre, duration = options.centre_rate, options.duration_rate
        super().__init__(
            [
                Parameter("starts", self.starts, True, centre, START),
                Parameter("ends", self.ends, True, centre, END),
                Parameter("log_appearing", self.log_appearing, True, duration, log_duration),
                Parameter("log_vanishing", self.log_vanishing, True, duration, log_duration),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats, less opaque the farther the time is outside of theirs."""
        first = torch.minimum(self.starts, self.ends)
        last = torch.maximum(self.starts, self.ends)
        early = (first - instant.time).relu() * inverse_durations(self.log_appearing)
        late = (instant.time - last).relu() * inverse_durations(self.log_vanishing)
        opacities = fade(moment.splats.logit_opacities, early.square() + late.square())
        return replace(moment, splats=replace(moment.splats, logit_opacities=opacities))

    def lives(self, splats: Splats) -> Tensor:
        """Return the two times in order, and both durations."""
        times = torch.stack([self.starts, self.ends], dim=1).sort(dim=1).values
        durations = torch.stack([self.log_appearing, self.log_vanishing], dim=1)
        return torch.cat([times, durations], dim=1).detach()


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> LifeSpan:
    """Return a layer that hides hardly anything until it has been trained."""
    return LifeSpan(options, len(splats))
