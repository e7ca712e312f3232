"""Multi-resolution hash grids (Instant-NGP: Mueller, Evans, Schied, Keller, SIGGRAPH 2022)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.hash_grid import cpu as kernels
from gsdmsr_cli.ops.hash_grid import cuda
from gsdmsr_cli.ops.hash_grid.levels import (
    PRIMES,
    Levels,
    check_table,
    new_levels,
    new_table,
)
from gsdmsr_cli.ops.hash_grid.twin import lookup_twin
from gsdmsr_cli.ops.live_rows import live_rows, spread

__all__ = ["Levels", "check_table", "lookup", "lookup_twin", "new_levels", "new_table"]


def lookup(levels: Levels, table: Tensor, points: Tensor) -> Tensor:
    """Return the features (N, L F) of points (N, d), d = 2 to 4.

    Each of the L levels gives F features, interpolated linearly along all axes between the grid
    points around; levels are side by side. Coordinates outside [-1, 1] are clamped to the border
    and pass no gradient. Grids are read in float32, whatever ``precision`` says.

    Args:
        levels: of the grid.
        table: (rows, F), see ``new_table``.
        points: (N, d), each coordinate in [-1, 1].
    """
    if points.shape[1] != levels.axes:
        raise ValueError(f"points of {points.shape[1]} coordinates in a grid of {levels.axes} axes")
    form = choose(points, table)
    if form == "cuda":
        return cuda.lookup(levels, table, points)
    if form == "cpu":
        features: Tensor = _Lookup.apply(levels, table, points.contiguous())
        return features
    return lookup_twin(levels, table, points)


class _Lookup(Function):
    """All levels, written side by side into one array of features."""

    @staticmethod
    def forward(ctx: Any, levels: Levels, table: Tensor, points: Tensor) -> Tensor:
        sizes, offsets = np.array(levels.resolutions), np.array(levels.offsets)
        ctx.laid_out = sizes, offsets, PRIMES[: levels.axes]
        features = torch.empty(len(points), len(sizes) * table.shape[1])
        kernels.lookup(array(points), array(table), *ctx.laid_out, array(features))
        ctx.save_for_backward(table, points)
        return features

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_features: Tensor) -> tuple[Tensor | None, ...]:
        table, points = ctx.saved_tensors
        count, rows, given = len(points), live_rows(d_features), d_features.contiguous()
        if rows is not None:
            points, given = points[rows], given[rows]
        wanted = ctx.needs_input_grad[2]
        d_table, axes = torch.empty_like(table), points.shape[1]
        d_points = torch.empty_like(points) if wanted else torch.empty(0, axes)
        shares = np.empty((len(ctx.laid_out[0]), len(d_points), axes), np.float32)
        kernels.lookup_backward(
            array(points), array(table), *ctx.laid_out, array(given),
            array(d_table), shares, array(d_points),
        )  # fmt: skip
        if wanted and rows is not None:
            d_points = spread(d_points, rows, count)
        return None, d_table, d_points if wanted else None
