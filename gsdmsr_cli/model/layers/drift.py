"""Every splat drifts at a constant velocity of its own, those that stand still as well.

The static splats of Ex4DGS (Lee et al., NeurIPS 2024): x(t) = x + d t. How far one
drifts says whether it is to be made dynamic, see the event ``convert``. Here time is counted from
the middle of the capture.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.strict import require, require_rates

SMALL = 1e-3
"""Ways that are shorter count as none [scene bounds]."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        rate: learning rate of the ways at the start and the end [scene bounds].
        sparsity: weight of the mean logarithm of the ways' lengths.
    """

    rate: tuple[float, float] = (1e-3, 2e-5)
    sparsity: float = 1e-4

    def __post_init__(self) -> None:
        require(self, "sparsity", self.sparsity >= 0, "0 or more")
        require_rates(self, "rate")


class Drift(Layer):
    """Ways (N, 3) from time 0 to time 1, in units of the bound."""

    concerns_still = True

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.sparsity, self.bound = options.sparsity, facts.bound
        self.ways = torch.zeros(count, 3)
        super().__init__([Parameter("ways", self.ways, per_splat=True, rate=options.rate)])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats that have drifted since half time."""
        means = moment.splats.means + ((instant.time - 0.5) * self.bound) * self.ways
        return replace(moment, splats=replace(moment.splats, means=means))

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Prefer few splats that drift far over many that drift a little."""
        return self.sparsity * torch.log(self.ways.norm(dim=1) + SMALL).mean()


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Drift:
    """Return a layer that is the identity until it has been trained."""
    return Drift(options, facts, len(splats))
