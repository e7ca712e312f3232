"""Every splat has a polynomial and a Fourier series of its own (Gaussian-Flow, Lin et al. 2024).

Its dual-domain deformation (CVPR 2024, section 3): the residual of an attribute is a polynomial,
which follows what drifts, plus a Fourier series, which follows what comes back. Both are evaluated
at a time that each splat has scaled and shifted for itself, so that one may move in a tenth of the
capture and its neighbour all the time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.options.strict import require, require_rates

ROWS = 1024
"""Splats whose smoothness is evaluated in a step."""


@dataclass(frozen=True)
class Options:
    """Settings of the residuals and their regulariser.

    Attributes:
        degree: of the polynomials of positions and rotations, 1 or more.
        harmonics: number of frequencies of their Fourier series, 0 or more; 3 in the paper.
        colour_degree, colour_harmonics: the same of colours; both 0 leave colours as they are.
        period: of the lowest frequency [durations of the capture].
        rate: learning rate of the positions' coefficients at the start and the end [scene bounds];
            those of other attributes follow the rate of what they are added to.
        time_rate: that of a splat's own scale and centre of time.
        smoothness: weight of the mean squared way of a splat between one train time and the next,
            in units of the bound.
    """

    degree: int = 3
    harmonics: int = 2
    colour_degree: int = 2
    colour_harmonics: int = 2
    period: float = 1.0
    rate: tuple[float, float] = (2e-3, 4e-5)
    time_rate: tuple[float, float] = (1e-3, 1e-4)
    smoothness: float = 0.1

    def __post_init__(self) -> None:
        require(self, "degree", self.degree >= 1, "1 or more")
        for key in ("harmonics", "colour_degree", "colour_harmonics"):
            require(self, key, getattr(self, key) >= 0, "0 or more")
        require(self, "period", self.period > 0, "a number above 0")
        require_rates(self, "rate", "time_rate")


class DualDomain(Layer):
    """What is stored plus c_1 s + .. + c_n s^n + sum of a_k sin(2 pi k s / T) + b_k cos(..).

    With s = exp(log_time_scale) (t - time_centre), both of the splat's own.
    """

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.options, self.facts = options, facts
        terms = options.degree + 2 * options.harmonics
        colour_terms = options.colour_degree + 2 * options.colour_harmonics
        self.log_time_scales, self.time_centres = torch.zeros(count), torch.full((count,), 0.5)
        self.means, self.quats = (torch.zeros(count, terms, c) for c in (3, 4))
        parameters = [
            Parameter("log_time_scales", self.log_time_scales, True, options.time_rate),
            Parameter("time_centres", self.time_centres, True, options.time_rate),
            Parameter("means", self.means, True, options.rate),
            Parameter("quats", self.quats, True, "quats"),
        ]
        self.colours = torch.zeros(count, colour_terms, 3) if colour_terms else None
        if self.colours is not None:
            parameters.append(Parameter("colours", self.colours, True, "sh"))
        super().__init__(parameters)

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats with what the series add at a time."""
        o, splats, times = self.options, moment.splats, self._own_times(instant.time)
        basis = time_basis(times, o.degree, o.harmonics, o.period)
        sh = splats.sh
        if self.colours is not None:
            own = time_basis(times, o.colour_degree, o.colour_harmonics, o.period)
            sh = add_series(sh.flatten(1), self.colours, own).view(sh.shape)
        moved = replace(
            splats,
            means=add_series(splats.means, self.means, basis, self.facts.bound),
            quats=add_series(splats.quats, self.quats, basis),
            sh=sh,
        )
        return replace(moment, splats=moved)

    def _own_times(self, time: float) -> Tensor:
        """Return the time as each splat has scaled and shifted it (N,)."""
        return self.log_time_scales.exp() * (time - self.time_centres)

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return how far splats go within a frame: the paper's time smoothness, of some of them."""
        o = self.options
        if not o.smoothness > 0:
            return None
        rows = torch.randperm(len(moment), generator=generator)[:ROWS].to(self.means.device)
        later = instant.time + 1 / max(self.facts.frames - 1, 1)
        way = self._offsets(rows, later) - self._offsets(rows, instant.time)
        return o.smoothness * way.square().sum(dim=1).mean()

    def _offsets(self, rows: Tensor, time: float) -> Tensor:
        """Return what is added to the means of some splats at a time, (M, 3) [bounds]."""
        o = self.options
        basis = time_basis(self._own_times(time)[rows], o.degree, o.harmonics, o.period)
        return add_series(self.means.new_zeros(len(rows), 3), self.means[rows], basis)


def time_basis(times: Tensor, degree: int, harmonics: int, period: float) -> Tensor:
    """Return s, .., s^degree, then sin and cos of each frequency, of times s (N,): (N, K)."""
    powers = [times]
    for _ in range(degree - 1):
        powers.append(powers[-1] * times)
    columns = [torch.stack(powers[:degree], dim=1)] if degree else []
    if harmonics:
        frequencies = torch.arange(1, harmonics + 1, device=times.device) * (2 * math.pi / period)
        angles = times[:, None] * frequencies.to(times)
        columns += [angles.sin(), angles.cos()]
    return torch.cat(columns, dim=1)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> DualDomain:
    """Return a motion that is the identity until its coefficients have been trained."""
    return DualDomain(options, facts, len(splats))
