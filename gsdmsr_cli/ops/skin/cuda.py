"""Splats that follow control points, on a GPU: transforms, blending, and their gradients.

See skinning.cu; what tensors hold is said in ``ops.skin``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda.launch import blocks, launch

COLUMNS = 19
"""Of a transform, as in skinning.cu."""

_SUMS = 24
"""Values that are added up for each point there."""

_THREADS = 128


def transforms(points: Tensor, deformation: Tensor, shortest: float) -> Tensor:
    """Return what ``ops.skin.transforms`` does, (M, 19) or (T, M, 19).

    Args:
        points, deformation: (M, 3), and (M, 10) or (T, M, 10).
        shortest: quaternions count as this long at least.
    """
    made: Tensor = _Transform.apply(points.contiguous(), deformation.contiguous(), shortest)
    return made


def skin(
    stored: tuple[Tensor, Tensor, Tensor],
    points: Tensor,
    log_radii: Tensor,
    transforms: Tensor,
    near: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return means, quats and log scales as ``ops.skin.skin`` does, with rows for each time.

    Args:
        stored: means (N, 3), quats (N, 4), log scales (N, 3).
        points, log_radii, transforms: (M, 3), (M,), (T, M, 19).
        near: (N, K) int32.
    """
    given = [t.contiguous() for t in (*stored, points, log_radii, transforms, near)]
    moved: tuple[Tensor, Tensor, Tensor] = _Skin.apply(*given)
    return moved


class _Transform(Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, deformation: Tensor, shortest: float) -> Tensor:
        made = points.new_empty(*deformation.shape[:-1], COLUMNS)
        count = deformation.shape[:-1].numel()
        grid, given = (blocks(count, _THREADS), 1), (count, len(points), shortest)
        launch("skinning", "transform", grid, _THREADS, *given, points, deformation, made)
        ctx.grid, ctx.given = grid, given
        ctx.save_for_backward(points, deformation, made)
        return made

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_made: Tensor) -> tuple[Tensor | None, ...]:
        points, deformation, made = ctx.saved_tensors
        d_points = points.new_empty(*deformation.shape[:-1], 3)
        d_deformation = torch.empty_like(deformation)
        launch(
            "skinning", "transform_backward", ctx.grid, _THREADS,
            *ctx.given, points, deformation, made, d_made.contiguous(), d_points, d_deformation,
        )  # fmt: skip
        return d_points if d_points.dim() == 2 else d_points.sum(dim=0), d_deformation, None


class _Skin(Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, ...]:
        means, quats, log_scales, points, log_radii, transforms, near = given
        weights, times = means.new_empty(near.shape), len(transforms)
        moved = tuple(t.new_empty(times, *t.shape) for t in (means, quats, log_scales))
        launch(
            "skinning", "skin", (blocks(len(means), _THREADS), 1), _THREADS,
            *near.shape, times, len(points), *given, weights, *moved,
        )  # fmt: skip
        ctx.save_for_backward(means, quats, points, log_radii, transforms, near, weights)
        return moved

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        means, quats, points, log_radii, transforms, near, weights = ctx.saved_tensors
        times, d_moved = len(transforms), [d.contiguous() for d in given]
        d_means, d_quats = torch.empty_like(means), torch.empty_like(quats)
        sums = means.new_zeros(times, len(points), _SUMS)
        launch(
            "skinning", "skin_backward", (blocks(len(means), _THREADS), 1), _THREADS,
            *near.shape, times, len(points), means, quats, points, log_radii, transforms, near,
            weights, *d_moved, d_means, d_quats, sums,
        )  # fmt: skip
        d_scaled, by_points = (t[0] if times == 1 else t.sum(dim=0) for t in (d_moved[2], sums))
        _, d_points, d_log_radii, _ = by_points.split([COLUMNS, 3, 1, 1], dim=1)
        d_transforms = sums[:, :, :COLUMNS]
        return d_means, d_quats, d_scaled, d_points, d_log_radii[:, 0], d_transforms, None
