"""Splats are Gaussians in space and time; what is drawn is their slice at a time.

4D Gaussian splatting (Yang Z. et al., ICLR 2024), section 3.2. A Gaussian over time and space that
lies obliquely to the axis of time is one that moves: with its covariance S, its slice at t has the
mean x + S_xt / S_tt (t - mu) and the covariance S_xx - S_xt S_tx / S_tt, and its opacity is
multiplied by the marginal exp(-(t - mu)^2 / (2 S_tt)).

S is R diag(scales)^2 R^T. Yang et al. make the rotation R of two quaternions, v -> a v b. Here a is
what is stored as ``quats``, and b its conjugate times the splat's ``tilts``: so a tilt of 1 is a
splat that stands still, and rotations in space mean what they do in every other motion.
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
from gsdmsr_cli.model.times import spread_times, take_known
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.ops.slices import Slices, slices
from gsdmsr_cli.options.strict import require, require_rates


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        duration: standard deviation in time that splats begin with [durations of the capture].
        split_duration: a growing splat with a longer one is split, however small it is in space.
        colour_harmonics: number of frequencies of the colours in time, the 4D spherindrical
            harmonics of section 3.3; 0 is none.
        time_rate: learning rate of the means in time at the start and the end.
        duration_rate: that of the logarithms of the durations.
        tilt_rate: that of the quaternions between space and time.
    """

    duration: float = 0.15
    split_duration: float = 0.05
    colour_harmonics: int = 0
    time_rate: tuple[float, float] = (1e-3, 1e-4)
    duration_rate: tuple[float, float] = (1e-2, 1e-3)
    tilt_rate: tuple[float, float] = (5e-3, 1e-4)

    def __post_init__(self) -> None:
        for key in ("duration", "split_duration"):
            require(self, key, getattr(self, key) > 0, "a number above 0")
        require(self, "colour_harmonics", self.colour_harmonics >= 0, "0 or more")
        require_rates(self, "time_rate", "duration_rate", "tilt_rate")


class Covariance4D(Layer):
    """Means (N,) and logarithms of durations (N,) in time, tilts (N, 4), and colours in time."""

    identity_at_start = False

    def __init__(self, options: Options, splats: Splats) -> None:
        count = len(splats)
        self.options = options
        self.times = spread_times(count)
        self.log_durations = torch.full((count,), math.log(options.duration))
        self.tilts = torch.zeros(count, 4)
        self.tilts[:, 0] = 1
        parameters = [
            Parameter("times", self.times, True, options.time_rate),
            Parameter("log_durations", self.log_durations, True, options.duration_rate),
            Parameter("tilts", self.tilts, True, options.tilt_rate),
        ]
        self.sh: Tensor | None = None
        if options.colour_harmonics:
            self.sh = torch.zeros(count, options.colour_harmonics, *splats.sh.shape[1:])
            parameters.append(Parameter("sh", self.sh, True, "sh"))
        super().__init__(parameters)

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the slices of the Gaussians at a time."""
        splats, since = moment.splats, instant.time - self.times
        cut = self._slices(splats, slice(None))
        drawn = replace(
            splats,
            means=splats.means + since[:, None] * cut.velocities,
            logit_opacities=_seen(splats, since, cut.variances),
            sh=splats.sh if self.sh is None else self._colours(splats.sh, since, self.sh),
        )
        return replace(moment, splats=drawn, axes=cut.axes)

    def _slices(self, splats: Splats, rows: Tensor | slice) -> Slices:
        """Slice the Gaussians of some rows, which ``splats`` are."""
        own = self.tilts[rows], self.log_durations[rows]
        return slices(splats.quats, splats.log_scales, *own)

    def _colours(self, before: Tensor, since: Tensor, sh: Tensor) -> Tensor:
        """Add to ``before`` (N, K, 3) the sum over n of sh (N, n, K, 3) cos(2 pi n (t - mu))."""
        order = torch.arange(1, sh.shape[1] + 1, device=sh.device)
        waves = torch.cos(2 * math.pi * since[:, None] * order)
        return add_series(before.flatten(1), sh.flatten(2), waves).view(before.shape)

    def lives(self, splats: Splats) -> Tensor:
        """Return lives about the times of the means, as long as the marginals."""
        durations = (2 * self._slices(splats, slice(None)).variances).log() / 2
        return torch.stack([self.times, self.times, durations, durations], dim=1).detach()

    def highest_opacities(self, splats: Splats) -> Tensor:
        """Return the logits at the times of the capture that are nearest to the means."""
        variances = self._slices(splats, slice(None)).variances
        return _seen(splats, self.times.clamp(0, 1) - self.times, variances)

    def begin_at(self, times: Tensor) -> None:
        """Let splats be seen around the times at which their points were."""
        take_known(self.times, times)

    def to_split(self) -> Tensor:
        """Return which splats are long in time (N,)."""
        return self.log_durations > math.log(self.options.split_duration)

    def scatter(
        self, children: Tensor, splats: Splats, shrink: float, generator: torch.Generator
    ) -> None:
        """Draw the children's times from their parents' extent in time, and make that shorter.

        A child goes along with its parent to its time, so that the four coordinates are drawn from
        the Gaussian in space and time.
        """
        rows = children.nonzero().flatten()
        cut = self._slices(splats.take(rows), rows)
        noise = torch.randn(len(rows), generator=generator).to(cut.variances)
        later = noise * cut.variances.sqrt()
        self.times[rows] += later
        splats.means[rows] += later[:, None] * cut.velocities
        self.log_durations[rows] -= math.log(shrink)


def _seen(splats: Splats, since: Tensor, variances: Tensor) -> Tensor:
    """Return the logits (N,) of the opacities times the marginals."""
    return fade(splats.logit_opacities, since.square() / (2 * variances))


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> Covariance4D:
    """Return Gaussians that do not move, spread evenly over time."""
    return Covariance4D(options, splats)
