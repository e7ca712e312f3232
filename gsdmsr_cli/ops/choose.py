"""Which form of an operation serves tensors: the one place that decides it.

An operation's folder has its forms side by side: ``cpu.py`` (Numba), ``cuda.py`` with a source in
CUDA C, and ``twin.py`` (plain torch, any device and type, to which tests hold the others). Where
the file of a form is missing, the twin takes its place.
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from gsdmsr_cli.backends.cuda.launch import serves
from gsdmsr_cli.backends.tensors import has_kernels

Form = Literal["cuda", "cpu", "twin"]


def choose(*tensors: Tensor) -> Form:
    """Return which form serves these tensors: kernels for float32 on one device, else the twin."""
    if serves(*tensors):
        return "cuda"
    return "cpu" if has_kernels(*tensors) else "twin"
