"""Hash grids in plain torch: features of points."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from gsdmsr_cli.ops.hash_grid.levels import PRIMES, Levels


def lookup_twin(levels: Levels, table: Tensor, points: Tensor) -> Tensor:
    """Return what ``lookup`` does, in plain torch, for any device and dtype."""
    return torch.cat([_sample(levels, i, table, points) for i in range(len(levels.resolutions))], 1)


def _sample(levels: Levels, level: int, table: Tensor, points: Tensor) -> Tensor:
    last = points.new_tensor(levels.resolutions[level]) - 1
    u = (points.clamp(-1, 1).nan_to_num(-1.0) + 1) * 0.5 * last
    lower = torch.minimum(u.detach().floor(), last - 1)
    weights = u - lower
    feature = table.new_zeros(len(points), table.shape[1])
    for corner in product((0, 1), repeat=levels.axes):
        upper = torch.tensor(corner, device=points.device)
        rows = _rows(levels, level, lower.long() + upper)
        share = torch.where(upper > 0, weights, 1 - weights).prod(dim=1, keepdim=True)
        feature = feature + share * table[rows]
    return feature


def _rows(levels: Levels, level: int, places: Tensor) -> Tensor:
    """Return the rows (N,) of the table that hold the grid points ``places`` (N, d)."""
    rows, stride = torch.zeros_like(places[:, 0]), 1
    for axis, size in enumerate(levels.resolutions[level]):
        if levels.is_hashed(level):
            rows = rows ^ (places[:, axis] * PRIMES[axis])
        else:
            rows = rows + places[:, axis] * stride
        stride *= size
    if levels.is_hashed(level):
        rows = rows & (levels.most - 1)
    return rows + levels.offsets[level]
