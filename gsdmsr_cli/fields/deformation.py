"""From a field's output to moved splats, and what field-based motions share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.autograd import Function

from gsdmsr_cli.fields.network import Layer
from gsdmsr_cli.fields.planes import Level
from gsdmsr_cli.splats import Splats

Part = TypeVar("Part", Level, Layer)

OUTPUTS = 10
"""Columns of a deformation: offsets of the mean (3), the quaternion (4) and the log scales (3)."""


def displace(splats: Splats, deformation: Tensor, shift: Tensor | None = None) -> Splats:
    """Add offsets to the stored values, before activation (4D-GS, equation 7).

    Args:
        splats: N canonical splats.
        deformation: (N, 10), see ``OUTPUTS``.
        shift: (N, 3) a further offset of the means.
    """
    means, quats, log_scales = _Displace.apply(
        splats.means, splats.quats, splats.log_scales, deformation, shift
    )
    return replace(splats, means=means, quats=quats, log_scales=log_scales)


class _Displace(Function):
    """Three sums. Written out because their gradient is one copy, and autograd would make ten."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        deformation: Tensor,
        shift: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        moved = means + deformation[:, :3]
        if shift is not None:
            moved += shift
        ctx.shifts = shift is not None
        return moved, quats + deformation[:, 3:7], log_scales + deformation[:, 7:]

    @staticmethod
    def backward(
        ctx: Any, d_means: Tensor, d_quats: Tensor, d_log_scales: Tensor
    ) -> tuple[Tensor | None, ...]:
        d_deformation = torch.cat([d_means, d_quats, d_log_scales], dim=1)
        return d_means, d_quats, d_log_scales, d_deformation, d_means if ctx.shifts else None


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
