"""Launches kernels on torch's tensors, whose addresses it hands to whoever runs them."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Protocol, cast

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import recording
from gsdmsr_cli.backends.cuda.driver import Driver

Argument = Tensor | int | float | ctypes.Structure | None
"""Tensors and None become pointers; int and float are C's; structures go by value."""


class Runner(Protocol):
    """Something that runs kernels on tensors of one kind of device."""

    def launch(
        self,
        source: str,
        kernel: str,
        grid: tuple[int, int],
        block: int,
        arguments: ctypes.Array[ctypes.c_void_p],
        device: torch.device,
    ) -> None:
        """Launch a kernel, see ``Driver.launch``."""


runners: dict[str, Runner] = {}
"""Who runs kernels on tensors of a type of device; the driver joins for "cuda" when needed."""


def launch(
    source: str,
    kernel: str,
    grid: tuple[int, int],
    block: int,
    *arguments: Argument,
    on: torch.device | None = None,
) -> None:
    """Launch ``kernel`` of ``source`` with a grid of blocks; nothing happens if the grid is empty.

    The device is that of the first tensor, unless it is given as ``on``. Tensors whose addresses
    are in structures are the caller's to check and to keep.

    Raises:
        GsdmsrError: the program does not compile, or the driver refuses it.
        ValueError: a tensor is not contiguous, or no tensor tells the device.
    """
    if 0 in grid:
        return
    values = [_c_value(argument) for argument in arguments]
    addresses = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
    device = on or next((a.device for a in arguments if isinstance(a, Tensor)), None)
    if device is None:
        raise ValueError(f"{kernel} was given no tensor")
    if device.type == "cuda":
        driver()
    given = source, kernel, grid, block, addresses, device
    runners[device.type].launch(*given)
    recording.tell(lambda: recording.Launched(*given, values))


def driver() -> Driver:
    """Return who runs kernels on NVIDIA GPUs."""
    if "cuda" not in runners:
        runners["cuda"] = Driver()
    return cast(Driver, runners["cuda"])


def serves(*tensors: Tensor) -> bool:
    """Return whether kernels run on these tensors: float32, on one kind of device with a runner.

    Others go to the plain torch twin of each kernel, or to the kernels of the CPU.
    """
    kinds = {tensor.device.type for tensor in tensors}
    there = kinds <= {"cuda", *runners} and len(kinds) == 1
    return there and all(tensor.dtype is torch.float32 for tensor in tensors)


def blocks(count: int, size: int) -> int:
    """Return how many blocks of ``size`` threads give each of ``count`` items one."""
    return -(-count // size)


def struct(*members: Tensor | int | float | None) -> ctypes.Structure:
    """Return a structure of pointers, ints and floats, in C's layout."""
    values = [_c_value(member) for member in members]
    return _layout(tuple(map(type, values)))(*values)


@cache
def _layout(types: tuple[type, ...]) -> type[ctypes.Structure]:
    fields = [(f"member{i}", kind) for i, kind in enumerate(types)]
    return type("Struct", (ctypes.Structure,), {"_fields_": fields})


def _c_value(argument: Argument) -> ctypes.c_void_p | ctypes.c_int | ctypes.c_float:
    if isinstance(argument, Tensor):
        if not argument.is_contiguous():
            raise ValueError("kernels read contiguous tensors only")
        return ctypes.c_void_p(argument.data_ptr())
    if argument is None:
        return ctypes.c_void_p(None)
    if isinstance(argument, ctypes.Structure):
        return argument  # type: ignore[return-value]
    return ctypes.c_float(argument) if isinstance(argument, float) else ctypes.c_int(argument)
