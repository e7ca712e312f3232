"""Every splat is opaque around a time of its own, and fades before and after it.

SpacetimeGaussians (STG; Li et al., CVPR 2024), section 4.1: o(t) = o exp(-((t - mu) / s)^2) with a
temporal centre mu and a duration s, the time after which 1 / e of the opacity o is left.
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
from gsdmsr_cli.model.times import inverse_durations, spread_times, take_known
from gsdmsr_cli.options.strict import require, require_rates


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        duration: that splats begin with, above 0 [durations of the capture].
        centre_rate: learning rate of the centres at the start and the end.
        duration_rate: that of the logarithms of the durations.
    """

    duration: float = 1.0
    centre_rate: tuple[float, float] = (1e-3, 1e-4)
    duration_rate: tuple[float, float] = (3e-2, 3e-3)

    def __post_init__(self) -> None:
        require(self, "duration", self.duration > 0, "above 0")
        require_rates(self, "centre_rate", "duration_rate")


class TemporalOpacity(Layer):
    """Centres (N,) and logarithms of durations (N,) [durations of the capture]."""

    identity_at_start = False

    def __init__(self, options: Options, count: int) -> None:
        self.centres = spread_times(count)
        log_duration = math.log(options.duration)
        self.log_durations = torch.full((count,), log_duration)
        rates = options.centre_rate, options.duration_rate
        super().__init__(
            [
                Parameter("centres", self.centres, True, rates[0], fill=0.5),
                Parameter("log_durations", self.log_durations, True, rates[1], fill=log_duration),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats, less opaque the farther their centres are."""
        apart = (instant.time - self.centres) * inverse_durations(self.log_durations)
        opacities = fade(moment.splats.logit_opacities, apart.square())
        return replace(moment, splats=replace(moment.splats, logit_opacities=opacities))

    def lives(self, splats: Splats) -> Tensor:
        """Return lives whose first time is the last: the centres."""
        duration = self.log_durations
        return torch.stack([self.centres, self.centres, duration, duration], dim=1).detach()

    def begin_at(self, times: Tensor) -> None:
        """Let splats be seen around the times at which their points were."""
        take_known(self.centres, times)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> TemporalOpacity:
    """Return a layer whose centres are spread evenly over time."""
    return TemporalOpacity(options, len(splats))
