"""Splats vibrate about their places and are seen for a while (PVG, Chen et al. 2023).

Periodic vibration Gaussians, section 3.2: around the time tau of its life's peak a splat goes along
x + l / (2 pi) sin(2 pi (t - tau) / l) v, with the velocity v at the peak and a cycle l that all
share, and its opacity is multiplied by exp(-(t - tau)^2 / (2 beta^2)). What has a long life span
beta compared with l, or no velocity, is a part of the scene that stands still.
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
from gsdmsr_cli.options.strict import require, require_rates

SHORTEST = 1e-6
"""Life spans count as this at least [durations of the capture]."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        period: of the vibration, the same for all splats [durations of the capture].
        life_span: that splats begin with [durations of the capture].
        split_life_span: a growing splat with a longer one is split, however small it is in space.
        smoothing: standard deviation of the time by which a training draws splats too early and
            moves them on at their mean velocity (section 3.3) [frames]; 0 is off.
        rate: learning rate of the velocities at the start and the end [scene bounds].
        peak_rate: that of the times of the peaks.
        life_span_rate: that of the logarithms of the life spans.
    """

    period: float = 0.4
    life_span: float = 0.2
    split_life_span: float = 0.05
    smoothing: float = 0.5
    rate: tuple[float, float] = (1e-2, 1e-4)
    peak_rate: tuple[float, float] = (1e-3, 1e-4)
    life_span_rate: tuple[float, float] = (1e-2, 1e-3)

    def __post_init__(self) -> None:
        for key in ("period", "life_span", "split_life_span"):
            require(self, key, getattr(self, key) > 0, "a number above 0")
        require(self, "smoothing", self.smoothing >= 0, "0 or more")
        require_rates(self, "rate", "peak_rate", "life_span_rate")


class Vibration(Layer):
    """Velocities (N, 3) in units of the bound, peaks (N,), and logarithms of life spans (N,)."""

    identity_at_start = False
    needs_jitter = True

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.options, self.bound = options, facts.bound
        self.frame = 1 / max(facts.frames - 1, 1)
        self.velocities = torch.zeros(count, 3)
        self.peaks = spread_times(count)
        self.log_life_spans = torch.full((count,), math.log(options.life_span))
        super().__init__(
            [
                Parameter("velocities", self.velocities, True, options.rate),
                Parameter("peaks", self.peaks, True, options.peak_rate),
                Parameter("log_life_spans", self.log_life_spans, True, options.life_span_rate),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats where they vibrate to, as opaque as they are at the time.

        In a training they are those of a little earlier or later, moved on at their mean velocity:
        so what is near in time has to go the same way, though each splat is seen for a while only.
        """
        apart = self.options.smoothing * self.frame * instant.jitter
        since, spans = instant.time - apart - self.peaks, self._life_spans()
        way = self._swing(since)
        if apart:
            way = way + apart * torch.exp(-spans / (2 * self.options.period))
        splats = replace(
            moment.splats,
            means=moment.splats.means + (self.bound * way)[:, None] * self.velocities,
            logit_opacities=_seen(moment.splats, since, spans),
        )
        return replace(moment, splats=splats)

    def _life_spans(self) -> Tensor:
        return self.log_life_spans.exp().clamp(min=SHORTEST)

    def _swing(self, since: Tensor) -> Tensor:
        """Return how long splats would have to go at full speed to where they are (N,)."""
        turn = 2 * math.pi / self.options.period
        return torch.sin(turn * since) / turn

    def lives(self, splats: Splats) -> Tensor:
        """Return lives about the peaks."""
        durations = self._life_spans().log() + 0.5 * math.log(2)
        return torch.stack([self.peaks, self.peaks, durations, durations], dim=1).detach()

    def highest_opacities(self, splats: Splats) -> Tensor:
        """Return the logits at the times of the capture that are nearest to the peaks."""
        return _seen(splats, self.peaks.clamp(0, 1) - self.peaks, self._life_spans())

    def begin_at(self, times: Tensor) -> None:
        """Let lives have their peaks at the times at which splats were seen."""
        take_known(self.peaks, times)

    def to_split(self) -> Tensor:
        """Return which splats have a long life (N,)."""
        return self.log_life_spans > math.log(self.options.split_life_span)

    def scatter(
        self, children: Tensor, splats: Splats, shrink: float, generator: torch.Generator
    ) -> None:
        """Draw the children's peaks from their parents' lives, and make those shorter.

        A child begins where its parent is at its peak, with the velocity that it has there.
        """
        rows = children.nonzero().flatten()
        spans, velocities = self._life_spans()[rows], self.velocities[rows]
        later = torch.randn(len(rows), generator=generator).to(spans) * spans
        self.peaks[rows] += later
        splats.means[rows] += (self.bound * self._swing(later))[:, None] * velocities
        slowed = torch.cos(2 * math.pi / self.options.period * later)
        self.velocities[rows] = slowed[:, None] * velocities
        self.log_life_spans[rows] -= math.log(shrink)


def _seen(splats: Splats, since: Tensor, spans: Tensor) -> Tensor:
    """Return the logits (N,) of the opacities, so long since the peaks of lives."""
    return fade(splats.logit_opacities, (since / spans).square() / 2)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Vibration:
    """Return splats that do not move, whose lives are spread evenly over time."""
    return Vibration(options, facts, len(splats))
