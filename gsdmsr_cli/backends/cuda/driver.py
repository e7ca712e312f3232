"""The NVIDIA driver through its C interface: loads compiled programs and launches their kernels."""

from __future__ import annotations

import ctypes
import sys
from ctypes import byref, c_char_p, c_int, c_size_t, c_uint, c_uint64, c_void_p
from typing import Any

import torch

from gsdmsr_cli.backends.cuda.compiler import compiled
from gsdmsr_cli.backends.cuda.nvrtc import load_nvrtc
from gsdmsr_cli.backends.cuda.recording import Launched
from gsdmsr_cli.ground.errors import GsdmsrError

_LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"


_CAPTURING = 1
"""CU_STREAM_CAPTURE_STATUS_ACTIVE."""


class _NodeParams(ctypes.Structure):
    """CUDA_KERNEL_NODE_PARAMS_v2; the last two, if given, stand for the function."""

    _fields_ = (
        ("function", c_void_p),
        *((name, c_uint) for name in ("grid_x", "grid_y", "grid_z")),
        *((name, c_uint) for name in ("block_x", "block_y", "block_z", "shared")),
        ("arguments", c_void_p),
        ("extra", c_void_p),
        ("kernel", c_void_p),
        ("context", c_void_p),
    )


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
        index = _index(device)
        self._enter(index)
        function = self._kernel(index, source, kernel)
        stream = _current_stream(index)
        self._check(
            self._cuda.cuLaunchKernel(
                function, *grid, 1, block, 1, 1, 0, stream, ctypes.addressof(arguments), None
            ),
            f"launching {kernel}",
        )

    def last_node(self, device: torch.device) -> int:
        """Return the node of the last launch on torch's current stream, which is being captured.

        Raises:
            GsdmsrError: the driver refuses, or nothing is captured there.
        """
        status, identity, graph = c_int(), c_uint64(), c_void_p()
        nodes, count = ctypes.POINTER(c_void_p)(), c_size_t()
        stream = c_void_p(_current_stream(_index(device)))
        found = byref(status), byref(identity), byref(graph), byref(nodes)
        ask = self._cuda.cuStreamGetCaptureInfo_v2
        self._check(ask(stream, *found, byref(count)), "asking what is captured")
        if status.value != _CAPTURING or count.value != 1:
            raise GsdmsrError(f"no launch is captured (status {status.value}, {count.value} nodes)")
        node: int = nodes[0]
        return node

    def instantiate(self, graph: int, device: torch.device) -> int:
        """Return the handle of a CUgraphExec, a graph that can be executed; see ``destroy``.

        Raises:
            GsdmsrError: the driver refuses.
        """
        self._enter(_index(device))
        made = c_void_p()
        self._check(
            self._cuda.cuGraphInstantiateWithFlags(byref(made), c_void_p(graph), c_uint64(0)),
            "making a graph",
        )
        assert made.value is not None
        return made.value

    def execute(self, executable: int, device: torch.device) -> None:
        """Launch a graph on torch's current stream.

        Raises:
            GsdmsrError: the driver refuses.
        """
        index = _index(device)
        self._enter(index)
        stream = c_void_p(_current_stream(index))
        self._check(self._cuda.cuGraphLaunch(c_void_p(executable), stream), "launching a graph")

    def destroy(self, executable: int) -> None:
        """Let go of a graph; one that runs is let go of afterwards."""
        self._cuda.cuGraphExecDestroy(c_void_p(executable))

    def give_node(self, executable: int, node: int, launched: Launched) -> None:
        """Give a launch of a graph that can be executed other arguments from now on.

        Args:
            executable: handle of a CUgraphExec.
            node: of the graph that it was made from, see ``last_node``.
            launched: the launch, with the addresses that the arguments are read from now.

        Raises:
            GsdmsrError: the driver refuses.
        """
        source, kernel, grid, block, arguments, device, _ = launched
        function = self._kernel(_index(device), source, kernel)
        params = _NodeParams(
            function, *grid, 1, block, 1, 1, 0, ctypes.addressof(arguments), None, None, None
        )
        self._check(
            self._cuda.cuGraphExecKernelNodeSetParams_v2(
                c_void_p(executable), c_void_p(node), byref(params)
            ),
            f"giving {kernel} other arguments",
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


def _index(device: torch.device) -> int:
    return torch.cuda.current_device() if device.index is None else device.index


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
