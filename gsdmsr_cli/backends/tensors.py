"""Where torch meets the kernels: tensors as arrays of the same memory, and when kernels serve."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor


def array(tensor: Tensor) -> NDArray[Any]:
    """Return the memory of a CPU tensor as an array, outside the graph."""
    return (tensor.detach() if tensor.requires_grad else tensor).numpy()


def has_kernels(*tensors: Tensor) -> bool:
    """Return whether the Numba kernels can serve these tensors: float32 on the CPU.

    Others (CUDA, or float64 in tests) go to the plain torch twin of each kernel.
    """
    return all(t.is_cpu and t.dtype is torch.float32 for t in tensors)
