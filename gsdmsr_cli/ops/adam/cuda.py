"""Adam on tensors: all of them moved by one kernel, see adam.cu."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from gsdmsr_cli.backends.cuda.compiler import MOST_TENSORS
from gsdmsr_cli.backends.cuda.launch import blocks, launch

_THREADS = 256
_MOST_BLOCKS = 1024
_POINTERS = ("values", "gradient", "first", "second", "multipliers", "trace")


class _Tensor(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in _POINTERS),
        *((name, ctypes.c_int) for name in ("length", "width")),
        *((name, ctypes.c_float) for name in ("step", "inverse2")),
    )


class _Tensors(ctypes.Structure):
    _fields_ = (("of", _Tensor * MOST_TENSORS),)


class Row(NamedTuple):
    """One tensor's step.

    Attributes:
        values, gradient, first, second: of one shape; the gradient is only read.
        step: rate / (1 - beta1^t).
        inverse2: 1 / (1 - beta2^t).
        multipliers: (N,) factor on the step of each row; a row with factor 0 keeps its values and
            moments. None for 1 everywhere.
        trace: like the tensor, out where there are multipliers: the steps with factor 1.
    """

    values: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: float
    inverse2: float
    multipliers: Tensor | None = None
    trace: Tensor | None = None


def adam(
    rows: Sequence[Row], beta1: float, beta2: float, eps: float, loss: Tensor | None = None
) -> None:
    """Make all steps in place; tensors are float32, contiguous and on one device.

    If a ``loss``, () float32, is given that is not finite, nothing is moved or written.
    """
    rows = [row for row in rows if row.values.numel()]
    for start in range(0, len(rows), MOST_TENSORS):
        some = rows[start : start + MOST_TENSORS]
        packed = _Tensors()
        for entry, row in zip(packed.of, some, strict=False):
            _fill(entry, row)
        longest = max(row.values.numel() for row in some)
        grid = min(blocks(longest, _THREADS), _MOST_BLOCKS), len(some)
        device = some[0].values.device
        betas = beta1, beta2, 1 - beta1, 1 - beta2
        launch("adam", "adam", grid, _THREADS, packed, *betas, eps, loss, on=device)


def _fill(entry: _Tensor, row: Row) -> None:
    for name in _POINTERS:
        tensor = getattr(row, name)
        if tensor is not None:
            if not tensor.is_contiguous():
                raise ValueError(f"{name} is not contiguous")
            setattr(entry, name, tensor.data_ptr())
    entry.length, entry.step, entry.inverse2 = row.values.numel(), row.step, row.inverse2
    entry.width = 0 if row.multipliers is None else entry.length // len(row.values)
