"""Plane grids in plain torch: features of points, and the regularisers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.backends.cpu.simd import LANES
from gsdmsr_cli.ops.planes.levels import CUBE, Box, Level, cubic_weights, to_cube

_SPACE_AXES = ((0, 1), (0, 2), (1, 2))


def lookup_twin(
    levels: Sequence[Level],
    points: Tensor,
    time: float,
    box: Box = CUBE,
    beside: Tensor | None = None,
    degree: int = 1,
) -> Tensor:
    """Return what ``lookup`` does, in plain torch, for any device and dtype."""
    scale, shift = points.new_tensor(to_cube(box))
    places, when = points * scale + shift, points.new_tensor(time)
    features = [_sample_level(level, places, when, degree) for level in levels]
    return torch.cat(features if beside is None else [*features, beside], dim=1)


def _cell(x: Tensor, size: int) -> tuple[Tensor, Tensor]:
    u = (x.clamp(-1, 1).nan_to_num(-1.0) + 1) * 0.5 * (size - 1)
    lower = u.detach().floor().clamp(0, size - 2).long()
    return lower, u - lower


def _sample_level(level: Level, points: Tensor, when: Tensor, degree: int) -> Tensor:
    size = level.space.shape[3]
    lower, upper_weight = _cell(points, size)
    moment, later = _cell(when, level.time.shape[2])
    if degree == 1:
        lines = torch.lerp(level.time[:, :, moment], level.time[:, :, moment + 1], later)
    else:
        weights = cubic_weights(moment + later, level.time.shape[2])
        lines = torch.einsum("t,pctrk->pcrk", weights, level.time)
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
