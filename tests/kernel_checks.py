"""How kernels are compared with their float64 twins and between numbers of threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numba
import pytest
import torch
from torch import Tensor

from gsdmsr_cli.backends.cpu.jit import threads


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def leaves(tensors: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Return copies of another type that collect gradients."""
    return [t.detach().to(dtype, copy=True).requires_grad_() for t in tensors]


def assert_near(found: Tensor | None, exact: Tensor | None, tolerance: float, what: str) -> None:
    """Hold the error to ``tolerance``, relative in the L2 norm, of a tensor or of a gradient."""
    assert found is not None and exact is not None, what
    assert found.shape == exact.shape, what
    error = (found.detach().double() - exact.detach().double()).norm()
    assert error <= tolerance * exact.detach().double().norm() + 1e-7, (what, float(error))


def assert_same_on_threads(compute: Callable[[], Sequence[Tensor]]) -> None:
    """Hold what ``compute`` returns to the same bits on one thread and on two."""
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba was started with one thread")
    before, results = threads(), []
    try:
        for count in (1, 2):
            numba.set_num_threads(count)
            results.append([tensor.detach().clone() for tensor in compute()])
    finally:
        numba.set_num_threads(before)
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)
