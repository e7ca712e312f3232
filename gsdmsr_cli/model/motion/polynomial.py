"""Every splat goes along a polynomial of its own and turns linearly, about a time of its own.

SpacetimeGaussians (STG; Li et al., CVPR 2024), section 4.1: with d = t - mu, the time since the
splat's temporal centre, x(t) = x + b_1 d + b_2 d^2 + b_3 d^3 and q(t) = normalise(q + d w). When a
splat is seen at all is a layer of its own, ``temporal_opacity``.

Here the polynomials are sums of Legendre polynomials less their values at mu: the same curves,
which are x at mu, in coordinates that do not depend on one another. With powers of d, splats that
are seen for long and have mu near an end of time did not find their ways (tests of recovery). And
mu is not trained: a curve is the same about any time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.model.times import spread_times, take_known
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.options.strict import require, require_rates

MOST = 16
"""Highest degree: what the pictures of a capture can tell apart is less."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        degree: of the polynomials of the positions, 1 to 16.
        rate: learning rate of their coefficients at the start and the end [scene bounds].
        turn_rate: that of the rotations' linear terms.
    """

    degree: int = 3
    rate: tuple[float, float] = (2e-3, 4e-5)
    turn_rate: tuple[float, float] = (1e-3, 1e-4)

    def __post_init__(self) -> None:
        require(self, "degree", 1 <= self.degree <= MOST, "1 to 16")
        require_rates(self, "rate", "turn_rate")


def legendre(places: Tensor, degree: int) -> Tensor:
    """Return the Legendre polynomials of degree 1 to ``degree`` at places (N,), (N, degree)."""
    found = [torch.ones_like(places), places]
    for n in range(1, degree):
        found.append(((2 * n + 1) * places * found[n] - n * found[n - 1]) / (n + 1))
    return torch.stack(found[1:], dim=1)


class PolynomialMotion(Layer):
    """Coefficients (N, degree, 3) in units of the bound, turns (N, 4), and centres (N,) in time."""

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.bound = facts.bound
        self.centres = spread_times(count)
        self.coefficients = torch.zeros(count, options.degree, 3)
        self.turns = torch.zeros(count, 4)
        super().__init__(
            [
                Parameter("centres", self.centres, per_splat=True, fill=0.5),
                Parameter("coefficients", self.coefficients, per_splat=True, rate=options.rate),
                Parameter("turns", self.turns, per_splat=True, rate=options.turn_rate),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved and turned splats."""
        splats, basis = moment.splats, self._basis(instant.time)
        since = (instant.time - self.centres)[:, None]
        moved = replace(
            splats,
            means=add_series(splats.means, self.coefficients, basis, self.bound),
            quats=splats.quats + since * self.turns,
        )
        return replace(moment, splats=moved)

    def _basis(self, time: float) -> Tensor:
        """Return how far each polynomial has gone since the centres, (N, degree)."""
        degree = self.coefficients.shape[1]
        now = legendre(self.centres.new_tensor([2 * time - 1]), degree)
        return now - legendre(2 * self.centres - 1, degree)

    def begin_at(self, times: Tensor) -> None:
        """Let ways be about the times at which splats were seen."""
        take_known(self.centres, times)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> PolynomialMotion:
    """Return a motion that is the identity until it has been trained."""
    return PolynomialMotion(options, facts, len(splats))
