"""Splats that follow the control points near them (SC-GS, Huang et al., CVPR 2024).

Linear blend skinning, section 3.2 there: a point at p with rotation R and offset T takes a place x
to R (x - p) + p + T, and a splat goes to the weighted mean of what its nearest points make of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.skin import cpu as kernels
from gsdmsr_cli.ops.skin import cuda
from gsdmsr_cli.ops.skin.twin import COLUMNS, skin_twin, transforms_twin


def transforms(points: Tensor, deformation: Tensor) -> Tensor:
    """Return what control points (M, 3) do to splats that follow them, (M, 19), see ``COLUMNS``.

    Args:
        points: their canonical places.
        deformation: (M, 10) offset of the place, of the quaternion (1, 0, 0, 0), which is then of
            unit length, and of the log scales; or (T, M, 10) of these, for (T, M, 19).
    """
    form = choose(points, deformation)
    if form == "cuda":
        return cuda.transforms(points, deformation, kernels.SHORTEST)
    if deformation.dim() == 3:
        return torch.stack([transforms(points, own) for own in deformation])
    if form == "cpu":
        made: Tensor = _Transform.apply(points, deformation)
        return made
    return transforms_twin(points, deformation)


def skin(
    splats: Splats, points: Tensor, log_radii: Tensor, transforms: Tensor, near: Tensor
) -> Splats:
    """Return N splats where the control points near them take them.

    Args:
        splats: N canonical splats.
        points: (M, 3) canonical places of the control points.
        log_radii: (M,) logarithms of how far they reach [world units].
        transforms: (M, 19), see ``transforms``.
        near: (N, K) int32, the control points that each splat follows.
    """
    stored = splats.means, splats.quats, splats.log_scales
    by = points, log_radii, transforms, near
    form = choose(*stored, *by[:3])
    if form == "cuda":
        return skin_at_times(splats, points, log_radii, transforms[None], near)[0]
    if form == "twin":
        return skin_twin(splats, *by)
    means, quats, log_scales = _Skin.apply(*stored, *by)
    return replace(splats, means=means, quats=quats, log_scales=log_scales)


def skin_at_times(
    splats: Splats, points: Tensor, log_radii: Tensor, transforms: Tensor, near: Tensor
) -> list[Splats]:
    """Return what ``skin`` does at each of T times, by one launch on a GPU.

    Args:
        splats, points, log_radii, near: as there.
        transforms: (T, M, 19), of each time.
    """
    stored = splats.means, splats.quats, splats.log_scales
    if choose(*stored, points, log_radii, transforms) != "cuda":
        return [skin(splats, points, log_radii, own, near) for own in transforms]
    moved = (part.unbind() for part in cuda.skin(stored, points, log_radii, transforms, near))
    return [
        replace(splats, means=means, quats=quats, log_scales=log_scales)
        for means, quats, log_scales in zip(*moved, strict=True)
    ]


__all__ = ["COLUMNS", "skin", "skin_at_times", "skin_twin", "transforms", "transforms_twin"]


class _Transform(Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, deformation: Tensor) -> Tensor:
        points, deformation = points.contiguous(), deformation.contiguous()
        made = points.new_empty(len(points), sum(COLUMNS))
        kernels.transform(*_arrays(points, deformation, made))
        ctx.save_for_backward(points, deformation, made)
        return made

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor, Tensor]:
        points, deformation, made = ctx.saved_tensors
        gradients = torch.empty_like(points), torch.empty_like(deformation)
        kernels.transform_backward(
            *_arrays(points, deformation, made, given.contiguous(), *gradients)
        )
        return gradients


class _Skin(Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        points: Tensor,
        log_radii: Tensor,
        transforms: Tensor,
        near: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        means, quats, log_scales = (t.contiguous() for t in (means, quats, log_scales))
        sharpness = torch.exp(-2 * log_radii)
        by = [t.contiguous() for t in (points, sharpness, transforms, near)]
        weights = torch.empty(near.shape)
        moved = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(log_scales)
        kernels.skin(*_arrays(means, quats, log_scales, *by, weights, *moved))
        ctx.save_for_backward(means, quats, *by, weights)
        return moved

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        means, quats, *by, near, weights = ctx.saved_tensors
        learnt = means, quats, *by
        d_moved, d_turned, d_scaled = (d.contiguous() for d in given)
        gradients = [torch.empty_like(tensor) for tensor in learnt]
        incoming = d_moved, d_turned, d_scaled
        kernels.skin_backward(*_arrays(*learnt, near, weights, *incoming, *gradients))
        d_means, d_quats, *others = gradients
        return d_means, d_quats, d_scaled, *others, None


def _arrays(*tensors: Tensor) -> Sequence[Any]:
    return [array(tensor) for tensor in tensors]
