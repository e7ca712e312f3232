"""Series on a GPU, see series.cu."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda.launch import blocks, launch

_THREADS = 128


def add_series(
    start: Tensor, coefficients: Tensor, basis: Tensor, scale: float, first: int
) -> Tensor:
    """Return what ``ops.series.add_series`` does; basis (N, K) or (1, K)."""
    given = (tensor.contiguous() for tensor in (start, coefficients, basis))
    found: Tensor = _Series.apply(*given, scale, first)
    return found


class _Series(Function):
    @staticmethod
    def forward(
        ctx: Any, start: Tensor, coefficients: Tensor, basis: Tensor, scale: float, first: int
    ) -> Tensor:
        found = torch.empty_like(start)
        ctx.grid = blocks(len(start), _THREADS), 1
        ctx.given = (
            len(start), start.shape[1], *coefficients.shape[1:], *basis.shape, first, float(scale),
        )  # fmt: skip
        launch(
            "series", "add_series", ctx.grid, _THREADS,
            *ctx.given, start, coefficients, basis, found,
        )  # fmt: skip
        ctx.save_for_backward(coefficients, basis)
        return found

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_found: Tensor) -> tuple[Tensor | None, ...]:
        coefficients, basis = ctx.saved_tensors
        d_coefficients = torch.empty_like(coefficients)
        d_basis = torch.empty_like(basis) if ctx.needs_input_grad[2] else None
        launch(
            "series", "add_series_backward", ctx.grid, _THREADS,
            *ctx.given, coefficients, basis, d_found.contiguous(), d_coefficients, d_basis,
        )  # fmt: skip
        return d_found, d_coefficients, d_basis, None, None
