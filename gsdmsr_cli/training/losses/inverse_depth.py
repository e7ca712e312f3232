"""What is drawn lies as far away as the pictures allow.

Depths of what has no texture, and of what few cameras see, are open: splats anywhere before a plain
wall look right in the train views, and are fog in front of a camera that stands elsewhere. Kin to
the occlusion regularisation of FreeNeRF (Yang, Pavone, Wang, CVPR 2023, section 3.4), which holds
down density near the cameras, but without a distance that is near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gsdmsr_cli.options.strict import require
from gsdmsr_cli.training.losses import Seen, Term
from gsdmsr_cli.training.losses._comparing import Schedule

LEAST_COVER = 0.05
"""Pixels count where the splats cover this much or more: elsewhere there is no depth."""

_NEAREST = 1e-6
"""Depth below which the inverse is taken of this [world units], so that it is finite."""


@dataclass(frozen=True)
class Options(Schedule):
    """See ``Schedule``.

    Attributes:
        shrink: both sides of the picture are divided by this before its depth is drawn: what is to
            be cleared away is larger than pixels.
    """

    factor: float = 0.03
    shrink: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "shrink", self.shrink >= 1, "1 or more")


class InverseDepth(Term):
    """The logarithm of the mean inverse depth, whose gradient has no unit of length."""

    of_depth: ClassVar[bool] = True

    def __init__(self, options: Options) -> None:
        self.options, self.every, self.shrink = options, options.every, options.shrink

    def weight(self, progress: float) -> float:
        """Return the factor until the term ends, then 0."""
        return self.options.weight(progress)

    def __call__(self, seen: Seen) -> Tensor:
        """Return log of the mean of alpha / (blended depth) over the pixels that count, ()."""
        assert seen.frame is not None and seen.frame.depth is not None
        alpha, depth = seen.frame.alpha, seen.frame.depth
        counts = alpha.detach() >= LEAST_COVER
        counted = seen.counted()
        if counted is not None:
            counts &= counted
        inverse = torch.where(counts, alpha / depth.clamp(min=_NEAREST), 0.0)
        covered = counts.sum()
        mean = inverse.sum() / covered.clamp(min=1)
        return torch.where(covered > 0, mean.clamp(min=_NEAREST).log(), 0.0)


def start(options: Options) -> InverseDepth:
    """Return the term."""
    return InverseDepth(options)
