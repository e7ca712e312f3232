"""Every splat has a place and a rotation of its own at each moment of the capture.

Dynamic 3D Gaussians (Luiten et al., 3DV 2024): the same splats all along, with constant colours,
opacities and sizes, each with a track of its own. Moments are trained one after the other, each
from the one before (``training.streaming``): what is trained is that of the newest alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.motion._streamed import Knot, Streamed
from gsdmsr_cli.options.strict import require_rates

STREAMED = True
"""It is learnt moment after moment."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        rate: learning rate of the places at the start and the end of a moment [scene bounds].
        turn_rate: that of the rotations.
    """

    rate: tuple[float, float] = (3e-3, 1e-4)
    turn_rate: tuple[float, float] = (1e-2, 5e-4)

    def __post_init__(self) -> None:
        require_rates(self, "rate", "turn_rate")


class Tracks(Streamed):
    """Where splats are, and how they are turned: the rows are the splats."""

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        super().__init__(facts, count, True, (options.rate, options.turn_rate))

    def of_splats(self, means: Tensor, index: int) -> Knot:
        """Return the rows themselves."""
        return self.knot(index)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Tracks:
    """Return a motion that is the identity until it has been trained."""
    return Tracks(options, facts, len(splats))
