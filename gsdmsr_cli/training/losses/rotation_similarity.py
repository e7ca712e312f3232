"""Neighbours turn alike from one time to the next (Luiten et al. 2024).

Dynamic 3D Gaussians (3DV 2024), equation 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.training.losses._neighbours import (
    Neighbourhoods,
    NeighbourOptions,
    NeighbourTerm,
    lengths,
)


@dataclass(frozen=True)
class Options(NeighbourOptions):
    """See ``Schedule`` and ``NeighbourOptions``."""


class RotationSimilarity(NeighbourTerm):
    """|q_j q_j'^-1 - q_i q_i'^-1|, the prime being an adjacent train time.

    Of the two quaternions of a rotation that one counts which is nearer.
    """

    needs_quats = True

    def deviations(self, now: Splats, other: Splats, found: Neighbourhoods) -> Tensor:
        """Return the lengths (S, K)."""
        own, theirs = (_turn(now.quats[r], other.quats[r]) for r in (found.rows, found.near))
        own = own[:, None]
        same = (own * theirs).sum(dim=2, keepdim=True) >= 0
        return lengths(torch.where(same, theirs, -theirs) - own)


def _turn(after: Tensor, before: Tensor) -> Tensor:
    """Return the unit quaternions (..., 4) that take rotations from ``before`` to ``after``."""
    inverse = before * before.new_tensor([1.0, -1.0, -1.0, -1.0])
    return quat_product(normalize(after, dim=-1), normalize(inverse, dim=-1))


def start(options: Options) -> RotationSimilarity:
    """Return the term."""
    return RotationSimilarity(options)
