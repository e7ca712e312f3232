"""Products of quaternions as matrices, for rotations of space and time."""

from __future__ import annotations

import torch
from torch import Tensor

_LEFT = (
    ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
    ((0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 0, -1), (0, 0, 1, 0)),
    ((0, 0, -1, 0), (0, 0, 0, 1), (1, 0, 0, 0), (0, -1, 0, 0)),
    ((0, 0, 0, -1), (0, 0, -1, 0), (0, 1, 0, 0), (1, 0, 0, 0)),
)
"""The matrices of v -> 1 v, i v, j v and k v."""


def left_products(quats: Tensor) -> Tensor:
    """Return the (N, 4, 4) matrices of v -> q v, for quaternions q (N, 4) wxyz."""
    entries = quats @ quats.new_tensor(_LEFT).flatten(1)
    return entries.view(-1, 4, 4)


def right_products(quats: Tensor) -> Tensor:
    """Return the (N, 4, 4) matrices of v -> v q, for quaternions q (N, 4) wxyz.

    v q is the conjugate of q* v*, so the matrix is that of q* from the left, conjugated.
    """
    signs = torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quats.dtype, device=quats.device)
    return signs[:, None] * left_products(quats * signs) * signs
