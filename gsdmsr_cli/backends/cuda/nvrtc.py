"""NVRTC, NVIDIA's run-time compiler, through its C interface: from CUDA C to machine code.

The library comes with pip: as nvidia-cuda-nvrtc, which torch's own CUDA builds require as well.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from ctypes import POINTER, byref, c_char_p, c_int, c_size_t, c_void_p
from functools import cache
from pathlib import Path

from gsdmsr_cli.ground.errors import GsdmsrError

_PATTERNS = ("nvrtc64_*.dll",) if sys.platform == "win32" else ("libnvrtc.so.*",)
_FOLDERS = ("nvidia/*/lib", "nvidia/*/bin", "nvidia/*/bin/*", "torch/lib")
_NAMES = ("libnvrtc.so.13", "libnvrtc.so.12")


class Nvrtc:
    """One loaded library.

    Attributes:
        version: major and minor, that of the CUDA toolkit it belongs to.
    """

    def __init__(self, library: ctypes.CDLL) -> None:
        self._library = library
        library.nvrtcGetErrorString.restype = c_char_p
        library.nvrtcCreateProgram.argtypes = [
            POINTER(c_void_p), c_char_p, c_char_p, c_int, POINTER(c_char_p), POINTER(c_char_p),
        ]  # fmt: skip
        library.nvrtcCompileProgram.argtypes = [c_void_p, c_int, POINTER(c_char_p)]
        for name in ("ProgramLog", "CUBIN", "PTX"):
            getattr(library, f"nvrtcGet{name}Size").argtypes = [c_void_p, POINTER(c_size_t)]
            getattr(library, f"nvrtcGet{name}").argtypes = [c_void_p, c_char_p]
        major, minor = c_int(), c_int()
        self._check(library.nvrtcVersion(byref(major), byref(minor)))
        self.version = major.value, minor.value

    def architectures(self) -> list[int]:
        """Return the compute capabilities it compiles for, in rising order; 90 stands for sm_90."""
        count = c_int()
        self._check(self._library.nvrtcGetNumSupportedArchs(byref(count)))
        found = (c_int * count.value)()
        self._check(self._library.nvrtcGetSupportedArchs(found))
        return sorted(found)

    def compile(
        self, name: str, source: str, headers: Mapping[str, str], options: Sequence[str], form: str
    ) -> tuple[bytes, str]:
        """Return the compiled program, and what the compiler has said.

        Args:
            name: of the source, for messages.
            source: CUDA C.
            headers: by the names that it includes them under.
            options: of the compiler.
            form: "CUBIN" (machine code) or "PTX" (for the driver to compile).

        Raises:
            GsdmsrError: the source does not compile.
        """
        program = c_void_p()
        texts = (c_char_p * len(headers))(*(text.encode() for text in headers.values()))
        names = (c_char_p * len(headers))(*(header.encode() for header in headers))
        self._check(
            self._library.nvrtcCreateProgram(
                byref(program), source.encode(), name.encode(), len(headers), texts, names
            )
        )
        try:
            given = (c_char_p * len(options))(*(option.encode() for option in options))
            status = self._library.nvrtcCompileProgram(program, len(options), given)
            log = self._get(program, "ProgramLog").decode(errors="replace").rstrip("\0\n")
            if status:
                raise GsdmsrError(f"{name} does not compile for {options[0]}: {log}")
            return self._get(program, form), log
        finally:
            self._library.nvrtcDestroyProgram(byref(program))

    def _get(self, program: c_void_p, what: str) -> bytes:
        size = c_size_t()
        self._check(getattr(self._library, f"nvrtcGet{what}Size")(program, byref(size)))
        buffer = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, f"nvrtcGet{what}")(program, buffer))
        return buffer.raw

    def _check(self, status: int) -> None:
        if status:
            message = self._library.nvrtcGetErrorString(status).decode()
            raise GsdmsrError(f"NVRTC failed: {message}")


@cache
def load_nvrtc(major: int | None = None) -> Nvrtc | None:
    """Return the library of CUDA ``major``, or the newest that there is; None if there is none.

    A driver may refuse machine code of a later major version than its own, so programs that are to
    run take the one torch was built with.
    """
    found = [Nvrtc(library) for library in _libraries()]
    fitting = [nvrtc for nvrtc in found if major in (None, nvrtc.version[0])]
    return max(fitting, key=lambda nvrtc: nvrtc.version, default=None)


def _libraries() -> Iterator[ctypes.CDLL]:
    """Load those of Python's packages and, if these have none, of the system."""
    paths = [
        path
        for root in dict.fromkeys(sys.path)
        for folder in _FOLDERS
        for pattern in _PATTERNS
        for path in sorted(Path(root or ".").glob(f"{folder}/{pattern}"))
        if "builtins" not in path.name and ".alt." not in path.name
    ]
    loaded = 0
    for name in (*map(os.fspath, paths), *_NAMES):
        if loaded and name in _NAMES:
            return
        try:
            for helper in sorted(Path(name).parent.glob("*nvrtc-builtins*")):
                ctypes.CDLL(os.fspath(helper))  # which it would look for in the system's folders
            library = ctypes.CDLL(name)
        except OSError:
            continue
        loaded += 1
        yield library
