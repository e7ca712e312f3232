"""Whether values are finite: asked of splats and of gradients before they can do harm."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.finite import cpu as kernels


def all_finite(tensors: Sequence[Tensor]) -> bool:
    """Return whether all values of the tensors are finite; waits for a GPU."""
    if all(t.is_contiguous() for t in tensors) and choose(*tensors) == "cpu":
        places = np.array([(t.data_ptr(), t.numel()) for t in tensors], np.int64).reshape(-1, 2)
        return bool(kernels.all_finite(places))
    return all(bool(t.isfinite().all()) for t in tensors)


def not_finite(tensors: Sequence[Tensor]) -> Tensor:
    """Return a number () that is 0 if all values are finite, else NaN; waits for nothing.

    Largest absolute values, of all tensors by one launch, are finite if and only if all are.
    """
    there = [tensor for tensor in tensors if tensor.numel()]
    if not there:
        return tensors[0].new_zeros(())
    return (torch.stack(torch._foreach_norm(there, math.inf)) * 0).sum()


def finite_rows(tensors: Sequence[Tensor], count: int) -> Tensor:
    """Return in which rows all values are finite, (count,) bool.

    Args:
        tensors: with at most ``count`` rows each; rows that one lacks are finite in it.
        count: of rows.
    """
    finite = torch.ones(count, dtype=torch.bool, device=tensors[0].device)
    for tensor in tensors:
        finite[: len(tensor)] &= tensor.isfinite()[:, None].flatten(1).all(dim=1)
    return finite
