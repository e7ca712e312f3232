"""Slices at a time of Gaussians in space and time (Yang Z. et al., ICLR 2024, section 3.2).

A Gaussian over time and space with the covariance S is conditioned on the time: its mean goes along
S_xt / S_tt, and its covariance is S_xx - S_xt S_tx / S_tt.

S is R diag(scales)^2 R^T. Yang et al. make the rotation R of two quaternions, v -> a v b. Here a is
that of space, and b its conjugate times a tilt: so a tilt of 1 is a splat that stands still.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.slices import cpu as kernels
from gsdmsr_cli.ops.slices import cuda
from gsdmsr_cli.ops.slices.twin import Slices, slices_twin

__all__ = ["Slices", "slices", "slices_twin"]


def slices(quats: Tensor, log_scales: Tensor, tilts: Tensor, log_durations: Tensor) -> Slices:
    """Return what the slices of N Gaussians have at all times.

    Args:
        quats: (N, 4) rotations in space, wxyz, of any length.
        log_scales: (N, 3) logarithms of the standard deviations [world units].
        tilts: (N, 4) quaternions, of any length, that lay the Gaussians obliquely to time.
        log_durations: (N,) logarithms of the standard deviations in time before that.
    """
    given = quats, log_scales, tilts, log_durations
    form = choose(*given)
    if form == "cpu":
        return Slices(*_Slices.apply(*(tensor.contiguous() for tensor in given)))
    if form == "cuda":
        return Slices(*cuda.slices(*given))
    return slices_twin(*given)


class _Slices(Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, ...]:
        count = len(given[0])
        made = torch.empty(count), torch.empty(count, 3), torch.empty(count, 3, 3)
        kernels.cut(*_arrays(given), *_arrays(made))
        ctx.save_for_backward(*given)
        return made

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *d_made: Tensor) -> tuple[Tensor, ...]:
        given, incoming = ctx.saved_tensors, [d.contiguous() for d in d_made]
        gradients = tuple(torch.empty_like(tensor) for tensor in given)
        kernels.cut_backward(*_arrays(given), *_arrays(incoming), *_arrays(gradients))
        return gradients


def _arrays(tensors: Sequence[Tensor]) -> list[Any]:
    return [array(tensor) for tensor in tensors]
