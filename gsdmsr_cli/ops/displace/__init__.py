"""Adds what a field says of splats to their means, rotations and log scales."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.displace import cpu as kernels
from gsdmsr_cli.ops.displace.twin import OUTPUTS, PARTS, displace_twin


def displace(splats: Splats, deformation: Tensor, shift: Tensor | None = None) -> Splats:
    """Add offsets to the stored values, before activation (4D-GS, equation 7).

    Args:
        splats: N canonical splats.
        deformation: (N, 10), see ``PARTS``.
        shift: (N, 3) a further offset of the means.
    """
    further = deformation.new_empty(0, 3) if shift is None else shift
    stored = splats.means, splats.quats, splats.log_scales
    if choose(*stored, deformation, further) == "cpu":
        means, quats, log_scales = _Displace.apply(*stored, deformation, further, shift is not None)
        return replace(splats, means=means, quats=quats, log_scales=log_scales)
    return displace_twin(splats, deformation, shift)


__all__ = ["OUTPUTS", "PARTS", "displace", "displace_twin"]


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
