"""Plane grids over space and time (HexPlane, Cao & Johnson 2023; K-Planes, Fridovich-Keil 2023)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.cuda import grids
from gsdmsr_cli.cuda.launch import serves
from gsdmsr_cli.fields import precision
from gsdmsr_cli.fields.live import live_rows, spread
from gsdmsr_cli.kernels import planes as kernels
from gsdmsr_cli.kernels.simd import LANES
from gsdmsr_cli.tensors import array, has_kernels

_SPACE_AXES = ((0, 1), (0, 2), (1, 2))

Corner = tuple[float, float, float]
Box = tuple[Corner, Corner]
"""Lower and upper corner [world units], the upper one above the lower along every axis."""

CUBE: Box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class Level(NamedTuple):
    """One resolution of a grid of C channels, C a multiple of 16.

    Attributes:
        space: (3, C / 16, R, R, 16) the planes xy, xz, yz; the second axis of a plane comes first.
        time: (3, C / 16, T, R, 16) the planes of x, y, z against time.
    """

    space: Tensor
    time: Tensor

    @property
    def channels(self) -> int:
        """Number of features the level adds."""
        return int(self.space.shape[1]) * LANES


def new_level(resolution: int, times: int, channels: int, generator: torch.Generator) -> Level:
    """Return a level that starts as 4D-GS's do: space uniform in [0.1, 0.5], time 1.

    Args:
        resolution: nodes along each spatial axis, at least 2.
        times: nodes in time, at least 2.
        channels: a multiple of 16.
        generator: source of the random values.
    """
    if channels % LANES or channels < LANES or resolution < 2 or times < 2:
        raise ValueError(
            f"a level has a multiple of {LANES} channels and at least 2 nodes along each axis, "
            f"not {channels} channels, {resolution} nodes in space and {times} in time"
        )
    chunks = channels // LANES
    space = torch.rand(3, chunks, resolution, resolution, LANES, generator=generator)
    return Level(space * 0.4 + 0.1, torch.ones(3, chunks, times, resolution, LANES))


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
) -> Tensor:
    """Return what ``lookup`` does at each of V times, (V N, C), one time after the other."""
    tensors = [tensor for level in levels for tensor in level]
    own = points.new_empty(len(points), 0) if beside is None else beside
    if serves(points, own, *tensors):
        to_cube = _to_cube(box).tolist()
        return grids.lookup(points, own, times, to_cube, tensors, precision.chosen())
    if has_kernels(points, own, *tensors):
        given = points.contiguous()
        features = [_Lookup.apply(given, own, time, box, *tensors) for time in times]
    else:
        features = [lookup_twin(levels, points, time, box, own) for time in times]
    return features[0] if len(features) == 1 else torch.cat(features)


def lookup_twin(
    levels: Sequence[Level],
    points: Tensor,
    time: float,
    box: Box = CUBE,
    beside: Tensor | None = None,
) -> Tensor:
    """Return what ``lookup`` does, in plain torch, for any device and dtype."""
    scale, shift = points.new_tensor(_to_cube(box))
    places, when = points * scale + shift, points.new_tensor(time)
    features = [_sample_level(level, places, when) for level in levels]
    return torch.cat(features if beside is None else [*features, beside], dim=1)


def _to_cube(box: Box) -> NDArray[np.float64]:
    """Return what to multiply by and what to add, (2, 3), to take the box to [-1, 1]^3."""
    lower, upper = np.array(box)
    return np.stack([2 / (upper - lower), -(upper + lower) / (upper - lower)])


def _cell(x: Tensor, size: int) -> tuple[Tensor, Tensor]:
    u = (x.clamp(-1, 1) + 1) * 0.5 * (size - 1)
    lower = u.detach().floor().clamp(0, size - 2).long()
    return lower, u - lower


def _sample_level(level: Level, points: Tensor, when: Tensor) -> Tensor:
    size = level.space.shape[3]
    lower, upper_weight = _cell(points, size)
    moment, later = _cell(when, level.time.shape[2])
    lines = torch.lerp(level.time[:, :, moment], level.time[:, :, moment + 1], later)
    feature = points.new_ones(level.space.shape[1], len(points), LANES)
    for plane, (first, second) in zip(level.space, _SPACE_AXES, strict=True):
        x, y = lower[:, first], lower[:, second]
        wx, wy = upper_weight[:, first, None], upper_weight[:, second, None]
        low = torch.lerp(plane[:, y, x], plane[:, y, x + 1], wx)
        high = torch.lerp(plane[:, y + 1, x], plane[:, y + 1, x + 1], wx)
        feature = feature * torch.lerp(low, high, wy)
    for line, axis in zip(lines, range(3), strict=True):
        x, w = lower[:, axis], upper_weight[:, axis, None]
        feature = feature * torch.lerp(line[:, x], line[:, x + 1], w)
    return feature.transpose(0, 1).reshape(len(points), level.channels)


class _Lookup(Function):
    """All levels at one time, written side by side into one array of features."""

    @staticmethod
    def forward(
        ctx: Any, points: Tensor, beside: Tensor, time: float, box: Box, *tensors: Tensor
    ) -> Tensor:
        spaces, times = (tuple(map(array, part)) for part in (tensors[::2], tensors[1::2]))
        lines = tuple(np.empty(plane.shape[:2] + plane.shape[3:], np.float32) for plane in times)
        ctx.columns = sum(plane.shape[1] * LANES for plane in spaces)
        features = torch.empty(len(points), ctx.columns + beside.shape[1])
        features[:, ctx.columns :] = beside
        when = _to_cube(box).astype(np.float32), time
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
        return d_points if wanted else None, d_beside, None, None, *gradients


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
    if serves(*tensors):
        return grids.penalty(weights, tensors)
    if has_kernels(*tensors):
        value: Tensor = _Penalty.apply(weights, *tensors)
        return value
    return penalty_twin(levels, *weights)


def penalty_twin(
    levels: Sequence[Level], space_weight: float, smooth_weight: float, still_weight: float
) -> Tensor:
    """Return what ``penalty`` does, in plain torch, for any device and dtype."""
    total = levels[0].space.new_zeros(())
    for space, time in levels:
        down = (space[:, :, 1:] - space[:, :, :-1]).square().mean()
        right = (space[:, :, :, 1:] - space[:, :, :, :-1]).square().mean()
        total = total + 3 * space_weight * (down + right)
        if time.shape[2] > 2:
            bend = time[:, :, 2:] - 2 * time[:, :, 1:-1] + time[:, :, :-2]
            total = total + 3 * smooth_weight * bend.square().mean()
        total = total + 3 * still_weight * (1 - time).abs().mean()
    return total


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
