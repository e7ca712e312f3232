"""The NVIDIA driver through its C interface: loads compiled programs and launches their kernels."""

from __future__ import annotations

import ctypes
import sys
from ctypes import byref, c_char_p, c_int, c_uint, c_void_p
from typing import Any

import torch

from gsdmsr_cli.backends.cuda.compiler import compiled
from gsdmsr_cli.backends.cuda.nvrtc import load_nvrtc
from gsdmsr_cli.ground.errors import GsdmsrError

_LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"


class Driver:
    """Runs kernels on torch's current stream, in the context that torch uses.

    Programs are compiled and loaded when one of their kernels is first launched on a device.
    """

    def __init__(self) -> None:
        self._cuda = ctypes.CDLL(_LIBRARY)
        self._cuda.cuLaunchKernel.argtypes = [
            c_void_p, *[c_uint] * 6, c_uint, c_void_p, c_void_p, c_void_p,
        ]  # fmt: skip
        self._contexts: dict[int, c_void_p] = {}
        self._programs: dict[tuple[int, str], c_void_p] = {}
        self._kernels: dict[tuple[int, str, str], c_void_p] = {}

    def launch(
        self,
        source: str,
        kernel: str,
        grid: tuple[int, int],
        block: int,
        arguments: ctypes.Array[c_void_p],
        device: torch.device,
    ) -> None:
        """Launch a kernel of a source.

        Args:
            source: name of a file of this folder, without its suffix.
            kernel: name of the function.
            grid: blocks along x and y.
            block: threads in a block.
            arguments: addresses of the arguments.
            device: where the kernel's tensors lie.

        Raises:
            GsdmsrError: the program does not compile, or the driver refuses it.
        """
        index = torch.cuda.current_device() if device.index is None else device.index
        self._enter(index)
        function = self._kernel(index, source, kernel)
        stream = _current_stream(index)
        self._check(
            self._cuda.cuLaunchKernel(
                function, *grid, 1, block, 1, 1, 0, stream, ctypes.addressof(arguments), None
            ),
            f"launching {kernel}",
        )

    def _enter(self, index: int) -> None:
        """Make the device's primary context current, as torch does only when it needs it itself."""
        if index not in self._contexts:
            torch.cuda.init()
            device, context = c_int(), c_void_p()
            self._check(self._cuda.cuDeviceGet(byref(device), index), "finding the card")
            self._check(
                self._cuda.cuDevicePrimaryCtxRetain(byref(context), device), "entering the card"
            )
            self._contexts[index] = context
        self._check(self._cuda.cuCtxSetCurrent(self._contexts[index]), "entering the card")

    def _kernel(self, index: int, source: str, kernel: str) -> c_void_p:
        key = index, source, kernel
        if key not in self._kernels:
            function = c_void_p()
            program = self._program(index, source)
            self._check(
                self._cuda.cuModuleGetFunction(byref(function), program, kernel.encode()),
                f"finding {kernel} in {source}.cu",
            )
            self._kernels[key] = function
        return self._kernels[key]

    def _program(self, index: int, source: str) -> c_void_p:
        key = index, source
        if key not in self._programs:
            nvrtc = load_nvrtc(built_for())
            if nvrtc is None:
                raise GsdmsrError("NVRTC is gone; pip install 'gsdmsr[cuda]' brings it")
            major, minor = torch.cuda.get_device_capability(index)
            program = c_void_p()
            image = compiled(nvrtc, source, 10 * major + minor)
            self._check(self._cuda.cuModuleLoadData(byref(program), image), f"loading {source}.cu")
            self._programs[key] = program
        return self._programs[key]

    def _check(self, status: int, doing: str) -> None:
        if status:
            text = c_char_p()
            self._cuda.cuGetErrorString(status, byref(text))
            reason = (text.value or b"unknown error").decode()
            raise GsdmsrError(f"the NVIDIA driver failed when {doing}: {reason} ({status})")


def _current_stream(index: int) -> int:
    """Return the address of torch's current stream on a card.

    What torch's own generated code asks: ``torch.cuda.current_stream`` makes an object of it, which
    takes longer than the launch.
    """
    address: int = torch._C._cuda_getCurrentRawStream(index)
    return address


def built_for() -> int | None:
    """Return the major version of CUDA that torch was built for, or None without CUDA."""
    version: Any = torch.version.cuda
    return None if version is None else int(version.split(".")[0])
