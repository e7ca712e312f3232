"""Builds the kernels for the CPU with g++ and runs them in place of the driver."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from gsdmsr_cli.backends.cuda import compiler, launch

SHIM = Path(__file__).parent / "backends" / "cuda" / "shim"
MISSING = None if shutil.which("g++") else "there is no g++ to build the kernels for the CPU with"
_INCLUDED = re.compile(r'#include "(\w+\.cuh)"')
_KERNEL = re.compile(
    r'extern "C" __global__ void (?:__launch_bounds__\((\w+)(?:, \w+)?\) )?(\w+)\('
)

MOST_THREADS = "1024"
"""Of a block, on any GPU."""


def kernels_of(source: str) -> dict[str, str]:
    """Return the most threads of a block that the kernels of a source, and of what it includes,
    are made for, an expression in C, by their names."""
    text, headers = compiler.source_path(source).read_text(encoding="utf-8"), compiler.headers()
    included = [headers[name] for name in _INCLUDED.findall(text)]
    found = _KERNEL.findall(text + "".join(path.read_text(encoding="utf-8") for path in included))
    return {kernel: most or MOST_THREADS for most, kernel in found}


class Shim:
    """Runs kernels on tensors in the memory of the CPU, see ``launch.Runner``.

    Attributes:
        backwards: whether blocks, warps and lanes take turns in the opposite order.
    """

    def __init__(self, folder: Path) -> None:
        self.backwards = False
        self._folder = folder
        self._libraries: dict[str, ctypes.CDLL] = {}

    def launch(
        self,
        source: str,
        kernel: str,
        grid: tuple[int, int],
        block: int,
        arguments: ctypes.Array[ctypes.c_void_p],
        device: torch.device,
    ) -> None:
        if source not in self._libraries:
            self._libraries[source] = ctypes.CDLL(str(self._build(source)))
        most = getattr(self._libraries[source], f"most_threads_of_{kernel}")()
        assert 0 < block <= most, f"{kernel} is made for {most} threads, not {block}"
        self._libraries[source].take_turns(ctypes.c_bool(self.backwards))
        getattr(self._libraries[source], f"run_{kernel}")(*grid, block, arguments)

    def _build(self, source: str) -> Path:
        runners = [
            f'extern "C" void run_{kernel}(int x, int y, int threads, void **given) {{\n'
            f"    auto work = [](void *given) {{ shim::call({kernel}, (void **)given); }};\n"
            f"    shim::run_grid(x, y, threads, work, given);\n}}\n"
            f'extern "C" int most_threads_of_{kernel}() {{ return {most}; }}\n'
            for kernel, most in kernels_of(source).items()
        ]
        runners.append(
            'extern "C" void take_turns(bool backwards) { shim::backwards = backwards; }'
        )
        text = f'#include "shim.h"\n#include "{source}.cu"\n' + "".join(runners)
        program, library = self._folder / f"{source}.cpp", self._folder / f"{source}.so"
        if library.is_file():
            return library
        program.write_text(text, encoding="utf-8")
        macros = [f"-D{name}={value}" for name, value in compiler.definitions().items()]
        line = ["g++", "-std=c++17", "-O2", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", "-w"]
        folders = {compiler.source_path(source).parent}
        folders |= {path.parent for path in compiler.headers().values()}
        places = [f"-I{folder}" for folder in (SHIM, *sorted(folders))]
        places += ["-o", str(library), str(program)]
        done = subprocess.run(
            [*line, *macros, *places], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return library


@contextmanager
def on_the_cpu(folder: Path) -> Iterator[Shim]:
    """Let kernels of tensors in the memory of the CPU be run by the shim."""
    earlier, shim = launch.runners.get("cpu"), Shim(folder)
    launch.runners["cpu"] = shim
    try:
        yield shim
    finally:
        if earlier is None:
            del launch.runners["cpu"]
        else:
            launch.runners["cpu"] = earlier
