"""Plane grids over space and time (HexPlane, Cao & Johnson 2023; K-Planes, Fridovich-Keil 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cpu.simd import LANES
from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops import precision
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.live_rows import live_rows, spread
from gsdmsr_cli.ops.planes import cpu as kernels
from gsdmsr_cli.ops.planes import cuda
from gsdmsr_cli.ops.planes.levels import (
    CUBE,
    DEGREES,
    TIME_AXES,
    Box,
    Corner,
    Level,
    Place,
    as_given,
    check_levels,
    evenly,
    features_of,
    new_level,
    new_levels,
    to_cube,
)
from gsdmsr_cli.ops.planes.twin import lookup_twin, penalty_twin

__all__ = [
    "CUBE",
    "DEGREES",
    "TIME_AXES",
    "Box",
    "Corner",
    "Level",
    "Place",
    "as_given",
    "check_levels",
    "evenly",
    "features_of",
    "lookup",
    "lookup_at_times",
    "lookup_twin",
    "new_level",
    "new_levels",
    "penalty",
    "penalty_twin",
    "to_cube",
]


def lookup(
    levels: Sequence[Level],
    points: Tensor,
    time: float,
    box: Box = CUBE,
    beside: Tensor | None = None,
) -> Tensor:
    """Return the features (N, sum of channels) of points (N, 3) in the box that the grid fills.

    Each level gives the product of six samples; levels are concatenated. The time is in [-1, 1].
    Coordinates outside are clamped to the border and pass no gradient. Features (N, K) that the
    points bring along, ``beside``, become the last columns. On a GPU grids are read in the format
    that ``precision`` says.
    """
    return lookup_at_times(levels, points, [time], box, beside)


def lookup_at_times(
    levels: Sequence[Level],
    points: Tensor,
    times: Sequence[float],
    box: Box = CUBE,
    beside: Tensor | None = None,
    place: Place = as_given,
    degree: int = 1,
) -> Tensor:
    """Return what ``lookup`` does at each of V times, (V N, C), one time after the other.

    Args:
        levels, points, box, beside: as there.
        times: in a step that is recorded those of its views, and so they are when it is replayed.
        place: takes each of the times to where it lies on the grid, in [-1, 1].
        degree: of the B-splines between the nodes in time, one of ``DEGREES``; with 3 a node has a
            part in four cells, see ``levels.cubic_weights``.
    """
    tensors = [tensor for level in levels for tensor in level]
    own = points.new_empty(len(points), 0) if beside is None else beside
    form = choose(points, own, *tensors)
    if form == "cuda":
        placed = to_cube(box).tolist()
        return cuda.lookup(points, own, times, placed, tensors, precision.chosen(), place, degree)
    if form == "cpu":
        given = points.contiguous()
        features = [_Lookup.apply(given, own, place(t), degree, box, *tensors) for t in times]
    else:
        features = [lookup_twin(levels, points, place(t), box, own, degree) for t in times]
    return features[0] if len(features) == 1 else torch.cat(features)


class _Lookup(Function):
    """All levels at one time, written side by side into one array of features."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        beside: Tensor,
        time: float,
        degree: int,
        box: Box,
        *tensors: Tensor,
    ) -> Tensor:
        spaces, times = (tuple(map(array, part)) for part in (tensors[::2], tensors[1::2]))
        lines = tuple(np.empty(plane.shape[:2] + plane.shape[3:], np.float32) for plane in times)
        ctx.columns = sum(plane.shape[1] * LANES for plane in spaces)
        features = torch.empty(len(points), ctx.columns + beside.shape[1])
        features[:, ctx.columns :] = beside
        when = to_cube(box).astype(np.float32), time, degree > 1
        kernels.lookup(array(points), *when, spaces, times, lines, array(features))
        ctx.when, ctx.spaces, ctx.lines = when, spaces, lines
        ctx.save_for_backward(points, *tensors)
        return features

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_features: Tensor) -> tuple[Tensor | None, ...]:
        points, *tensors = ctx.saved_tensors
        count, rows, given = len(points), live_rows(d_features), d_features.contiguous()
        if rows is not None:
            points, given = points[rows], given[rows]
        wanted = ctx.needs_input_grad[0]
        d_points = torch.empty_like(points) if wanted else torch.empty(0, 3)
        gradients = [torch.empty_like(tensor) for tensor in tensors]
        shares = np.empty((ctx.columns // LANES, len(d_points), 3), np.float32)
        kernels.lookup_backward(
            array(points), *ctx.when, ctx.spaces, ctx.lines, array(given),
            tuple(map(array, gradients[::2])), tuple(map(array, gradients[1::2])),
            tuple(map(np.empty_like, ctx.lines)), shares, array(d_points),
        )  # fmt: skip
        if wanted and rows is not None:
            d_points = spread(d_points, rows, count)
        d_beside = d_features[:, ctx.columns :] if ctx.needs_input_grad[1] else None
        return d_points if wanted else None, d_beside, None, None, None, *gradients


def penalty(
    levels: Sequence[Level], space_weight: float, smooth_weight: float, still_weight: float
) -> Tensor:
    """Return the plane regularisers of HexPlane and 4D-GS, summed over levels and planes.

    Each is a mean over a plane: ``space_weight`` times squared first differences along both axes
    of the spatial planes, ``smooth_weight`` times squared second differences in time and
    ``still_weight`` times |1 - value| of the temporal ones.
    """
    tensors = [tensor for level in levels for tensor in level]
    weights = space_weight, smooth_weight, still_weight
    form = choose(*tensors)
    if form == "cuda":
        return cuda.penalty(weights, tensors)
    if form == "cpu":
        value: Tensor = _Penalty.apply(weights, *tensors)
        return value
    return penalty_twin(levels, *weights)


class _Penalty(Function):
    """The value and, in the same pass over memory, the gradients."""

    @staticmethod
    def forward(ctx: Any, weights: tuple[float, float, float], *tensors: Tensor) -> Tensor:
        space_weight, smooth_weight, still_weight = weights
        total, gradients = 0.0, []
        for space, time in zip(tensors[::2], tensors[1::2], strict=True):
            d_space, d_time = torch.empty_like(space), torch.empty_like(time)
            sums = np.empty((2, 3 * space.shape[1]))
            kernels.space_penalty(array(space), space_weight, array(d_space), sums[0])
            kernels.time_penalty(array(time), smooth_weight, still_weight, array(d_time), sums[1])
            total += float(sums.sum())
            gradients += [d_space, d_time]
        ctx.gradients = gradients
        return torch.tensor(total)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_value: Tensor) -> tuple[Tensor | None, ...]:
        scale = float(d_value)
        return None, *(g if scale == 1.0 else g.mul_(scale) for g in ctx.gradients)
