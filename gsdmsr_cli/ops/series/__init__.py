"""Adds to each splat the sum of a series of its own: a polynomial, a Fourier series, a spline.

A motion of many terms is a pass over its coefficients and little else, so the sum and both its
gradients are such a pass each.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.series import cpu as kernels
from gsdmsr_cli.ops.series import cuda
from gsdmsr_cli.ops.series.twin import add_series_twin

__all__ = ["add_series", "add_series_twin"]


def add_series(
    start: Tensor,
    coefficients: Tensor,
    basis: Tensor | Sequence[float],
    scale: float = 1.0,
    first: int = 0,
) -> Tensor:
    """Return ``start`` plus scale times the sum of terms k, basis k times coefficient first + k.

    Args:
        start: (N, D) with D >= C; of more columns than C the first ones are added to.
        coefficients: (N, J, C) with J >= first + K.
        basis: (N, K) values of the basis of each splat, or K numbers for all.
        scale: of the sum.
        first: coefficient that the first value of the basis is of.
    """
    own = basis if isinstance(basis, Tensor) else start.new_tensor(basis)[None]
    form = choose(start, coefficients, own)
    if form == "cuda":
        return cuda.add_series(start, coefficients, own, scale, first)
    if form == "cpu":
        given = (tensor.contiguous() for tensor in (start, coefficients, own))
        found: Tensor = _Series.apply(*given, scale, first)
        return found
    return add_series_twin(start, coefficients, own, scale, first)


class _Series(Function):
    @staticmethod
    def forward(
        ctx: Any, start: Tensor, coefficients: Tensor, basis: Tensor, scale: float, first: int
    ) -> Tensor:
        found = torch.empty_like(start)
        ctx.given = np.float32(scale), first, (0,) * coefficients.shape[2]
        kernels.add(*map(array, (start, coefficients, basis)), *ctx.given, array(found))
        ctx.save_for_backward(coefficients, basis)
        return found

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_found: Tensor) -> tuple[Tensor | None, ...]:
        coefficients, basis = ctx.saved_tensors
        wanted = ctx.needs_input_grad[2]
        whole = basis.shape[1] == coefficients.shape[1]
        d_coefficients = (torch.empty_like if whole else torch.zeros_like)(coefficients)
        d_basis = torch.empty_like(basis) if wanted else torch.empty(0, 0)
        kernels.add_backward(
            *map(array, (coefficients, basis, d_found.contiguous())), *ctx.given,
            array(d_coefficients), array(d_basis),
        )  # fmt: skip
        return d_found, d_coefficients, d_basis if wanted else None, None, None
