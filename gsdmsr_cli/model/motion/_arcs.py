"""Turns of splats that motions keep as what is added to the quaternion of no rotation."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

LARGEST_COSINE = 1 - 1e-4
"""Beyond it, arcs are as good as chords; the arc cosine has no slope there that could be used."""


def turned(added: Tensor) -> Tensor:
    """Return unit quaternions (N, 4) of what has been added to that of no rotation (N, 4)."""
    return normalize(added + added.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=1)


def added_to_none(quats: Tensor) -> Tensor:
    """Return what unit quaternions (N, 4) add to that of no rotation (N, 4), see ``turned``."""
    return quats - quats.new_tensor([1.0, 0.0, 0.0, 0.0])


def slerp(first: Tensor, second: Tensor, u: float) -> Tensor:
    """Return the rotations (N, 4) at u in [0, 1] on the shorter arcs between two.

    ``first`` and ``second`` (N, 4) are what has been added to the quaternion of no rotation.
    """
    a, b = turned(first), turned(second)
    cosine = (a * b).sum(dim=1, keepdim=True)
    b = torch.where(cosine < 0, -b, b)
    angle = torch.acos(cosine.abs().clamp(max=LARGEST_COSINE))
    between = torch.sin((1 - u) * angle) * a + torch.sin(u * angle) * b
    return normalize(between, dim=1)
