"""Slices of Gaussians in space and time on a GPU, see slices.cu."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda.launch import blocks, launch
from gsdmsr_cli.ops.slices.cpu import LEAST_VARIANCE

_THREADS = 128


def slices(*given: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return variances, velocities and axes as ``ops.slices.slices`` does."""
    made: tuple[Tensor, Tensor, Tensor] = _Slices.apply(*(t.contiguous() for t in given))
    return made


class _Slices(Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> tuple[Tensor, ...]:
        count, quats = len(given[0]), given[0]
        made = tuple(quats.new_empty(count, *shape) for shape in ((), (3,), (3, 3)))
        ctx.grid = blocks(count, _THREADS), 1
        launch("slices", "cut", ctx.grid, _THREADS, count, LEAST_VARIANCE, *given, *made)
        ctx.save_for_backward(*given)
        return made

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *d_made: Tensor) -> tuple[Tensor, ...]:
        given, incoming = ctx.saved_tensors, [d.contiguous() for d in d_made]
        gradients = tuple(torch.empty_like(tensor) for tensor in given)
        launch(
            "slices", "cut_backward", ctx.grid, _THREADS,
            len(given[0]), LEAST_VARIANCE, *given, *incoming, *gradients,
        )  # fmt: skip
        return gradients
