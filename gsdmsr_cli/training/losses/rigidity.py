"""Neighbours move as a rigid body that turns as each splat does (Luiten et al. 2024).

Dynamic 3D Gaussians (3DV 2024), equation 4: what splat i's own rotation makes of the way to its
neighbour j, less that way as it is, here in units of the distance between neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.training.losses._neighbours import (
    Neighbourhoods,
    NeighbourOptions,
    NeighbourTerm,
    lengths,
)


@dataclass(frozen=True)
class Options(NeighbourOptions):
    """See ``Schedule`` and ``NeighbourOptions``."""


class Rigidity(NeighbourTerm):
    """|(x_j' - x_i') - R_i' R_i^-1 (x_j - x_i)|, the prime being an adjacent train time."""

    needs_quats = True

    def deviations(self, now: Splats, other: Splats, found: Neighbourhoods) -> Tensor:
        """Return the lengths (S, K)."""
        turns, before = (quat_to_rotmat(one.quats[found.rows]) for one in (now, other))
        back = before @ turns.mT
        taken = found.apart(now.means) @ back.mT
        return lengths(found.apart(other.means) - taken) / found.size


def start(options: Options) -> Rigidity:
    """Return the term."""
    return Rigidity(options)
