"""From a field's output to moved splats, and what field-based motions share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.fields.network import Layer
from gsdmsr_cli.fields.planes import Level
from gsdmsr_cli.kernels import deformation as kernels
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.tensors import array, has_kernels

Part = TypeVar("Part", Level, Layer)

PARTS = [kernels.MEAN, kernels.QUAT, kernels.SCALE]
"""Columns of a deformation: offsets of the mean (3), the quaternion (4) and the log scales (3)."""

OUTPUTS = sum(PARTS)


def displace(splats: Splats, deformation: Tensor, shift: Tensor | None = None) -> Splats:
    """Add offsets to the stored values, before activation (4D-GS, equation 7).

    Args:
        splats: N canonical splats.
        deformation: (N, 10), see ``PARTS``.
        shift: (N, 3) a further offset of the means.
    """
    further = deformation.new_empty(0, 3) if shift is None else shift
    stored = splats.means, splats.quats, splats.log_scales
    if has_kernels(*stored, deformation, further):
        means, quats, log_scales = _Displace.apply(*stored, deformation, further, shift is not None)
        return replace(splats, means=means, quats=quats, log_scales=log_scales)
    return displace_twin(splats, deformation, shift)


def displace_twin(splats: Splats, deformation: Tensor, shift: Tensor | None = None) -> Splats:
    """Return what ``displace`` does, in plain torch, for any device and dtype."""
    offset, turn, growth = deformation.split(PARTS, dim=1)
    return replace(
        splats,
        means=splats.means + offset + (0 if shift is None else shift),
        quats=splats.quats + turn,
        log_scales=splats.log_scales + growth,
    )


class _Displace(Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        deformation: Tensor,
        shift: Tensor,
        shifted: bool,
    ) -> tuple[Tensor, Tensor, Tensor]:
        means, quats, log_scales = (t.contiguous() for t in (means, quats, log_scales))
        moved = (torch.empty_like(means), torch.empty_like(quats), torch.empty_like(log_scales))
        given = map(array, (means, quats, log_scales, deformation, shift))
        kernels.displace(*given, *map(array, moved))
        ctx.shifted = shifted
        return moved

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        d_means, d_quats, d_log_scales = (d.contiguous() for d in given)
        d_deformation = torch.empty(len(d_means), OUTPUTS)
        incoming = [array(d) for d in (d_means, d_quats, d_log_scales)]
        kernels.displace_backward(*incoming, array(d_deformation))
        d_shift = d_means if ctx.shifted else None
        return d_means, d_quats, d_log_scales, d_deformation, d_shift, None


def split_times(rows: Tensor, count: int) -> Sequence[Tensor]:
    """Return the rows (N, K) of each of ``count`` times, which ``rows`` (count N, K) holds."""
    return [rows] if count == 1 else rows.unflatten(0, (count, len(rows) // count)).unbind()


def time_nodes(frames: int, cells_per_frame: float, least: int = 8) -> int:
    """Return the nodes of a time grid for so many distinct times, ``least`` or more."""
    return max(round(frames * cells_per_frame), least)


def name_tensors(
    levels: dict[str, list[Level]], layers: dict[str, list[Layer]]
) -> dict[str, Tensor]:
    """Return all tensors of grids and networks as "grid.0.space", "network.1.weight" and so on."""
    named: dict[str, Tensor] = {}
    every: dict[str, Sequence[Level | Layer]] = {**levels, **layers}
    for name, parts in every.items():
        for index, part in enumerate(parts):
            for field, tensor in part._asdict().items():
                named[f"{name}.{index}.{field}"] = tensor
    return named


def trained(part: Part) -> Part:
    """Return the level or layer with tensors that collect gradients."""
    return type(part)(*(torch.nn.Parameter(tensor) for tensor in part))
