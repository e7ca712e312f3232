"""Neighbourhoods move as rigidly as possible, whatever the rotations of their splats are.

Sorkine & Alexa (SGP 2007), equation 3, as SC-GS (Huang et al., CVPR 2024, section 3.3) has it of
control points; here of splats, so that it serves any motion, and in units of the squared distance
between neighbours. The rotation of a neighbourhood is the best there is, by which the energy has no
gradient.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import as_rigid_as_possible
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses._comparing import any_time
from gsdmsr_cli.training.losses._neighbours import (
    Neighbourhoods,
    NeighbourOptions,
    NeighbourTerm,
)


@dataclass(frozen=True)
class Options(NeighbourOptions):
    """See ``Schedule`` and ``NeighbourOptions``."""


class AsRigidAsPossible(NeighbourTerm):
    """|(x_j - x_i) - R_i (x_j' - x_i')|^2, the prime being any train time."""

    def other_time(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> float | None:
        """Return any other train time."""
        return any_time(view.time, times, generator)

    def deviations(self, now: Splats, other: Splats, found: Neighbourhoods) -> Tensor:
        """Return the squared lengths (S, K)."""
        after, before = (found.apart(one.means) for one in (now, other))
        return as_rigid_as_possible(after, before, found.weights) / found.size.square()


def start(options: Options) -> AsRigidAsPossible:
    """Return the term."""
    return AsRigidAsPossible(options)
