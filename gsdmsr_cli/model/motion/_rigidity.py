"""How far control points are from moving as parts of a rigid body would."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.ops.skin import COLUMNS

_COINCIDENT = 1e-4
"""Squares of distances count as this share of their mean at least: rounding would count else."""


def rigidity(points: Tensor, transforms: Tensor, near: Tensor) -> Tensor:
    """Return how far points are from moving as parts of a rigid body, a scalar, 0 where they do.

    The regulariser E_reg of embedded deformation (Sumner, Schmid, Pauly, SIGGRAPH 2007): the square
    of where a point takes its neighbour less where that goes by itself, here in units of the
    distance between them; the mean over all pairs.

    Args:
        points: (M, 3) canonical places.
        transforms: (M, 19), see ``transforms``.
        near: (M, K) int32, the neighbours of each; itself, if among them, adds 0.
    """
    matrix, shift, _, _ = transforms.split(COLUMNS, dim=1)
    matrix, rows = matrix.unflatten(1, (3, 3)), near.flatten().long()
    offset = (matrix @ points[:, :, None])[:, :, 0] + shift
    places, goes = (t.index_select(0, rows).unflatten(0, near.shape) for t in (points, offset))
    apart = places - points[:, None]
    taken = apart @ matrix.transpose(1, 2) + offset[:, None]
    squares = apart.square().sum(dim=2)
    squares = torch.maximum(squares, _COINCIDENT * squares.mean())
    deviations = (taken - goes).square().sum(dim=2)
    return torch.mean(deviations / squares)
