"""How every kernel is compiled: options, threads, and an on-disk cache that notices edits."""

from __future__ import annotations

import ctypes
import hashlib
import multiprocessing
import os
import sys
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def _sources_hash() -> str:
    digest = hashlib.sha256()
    for path in (*sorted(HERE.glob("*.py")), HERE.parent / "splatting_constants.py"):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Folder of compiled kernels: beside the sources if that is writable, else the user's cache.

    Numba alone would not recompile a kernel when a helper in another module changes, so the
    folder's name is a hash of all kernel sources and of the constants compiled into them.
    """
    beside = HERE / "__pycache__"
    try:
        beside.mkdir(exist_ok=True)
        writable = os.access(beside, os.W_OK)
    except OSError:
        writable = False
    if writable:
        return beside / _sources_hash()
    home = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return home / "gsdmsr" / _sources_hash()


def _keep_large_blocks_in_the_heap() -> None:
    """Stop glibc from returning large freed blocks to the system.

    A fresh picture-sized buffer otherwise costs its page faults (about 1.4 GB/s) every step. Other
    C libraries are left alone.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        m_trim_threshold, m_mmap_max = -1, -4
        mallopt(m_mmap_max, 0)
        mallopt(m_trim_threshold, 2**31 - 1)


def _load_tbb() -> None:
    """Load the threading library that pip installed, which the system's loader does not find.

    Numba prefers it where it is. Its threads spin briefly, yield and then sleep, which suits many
    short kernels both on an idle machine and on a busy one; OpenMP's can only do one or the other.
    """
    try:
        files = metadata.distribution("tbb").files or []
        library = next(f.locate() for f in files if f.name in ("libtbb.so.12", "tbb12.dll"))
        ctypes.CDLL(str(Path(str(library)).resolve()), mode=ctypes.RTLD_GLOBAL)
    except (metadata.PackageNotFoundError, StopIteration, OSError):
        return  # OpenMP serves, or Numba's own threads


_keep_large_blocks_in_the_heap()
_load_tbb()

import numba  # noqa: E402  (finds TBB only if that is loaded by now)

# set in both places: Numba has read its environment already if anybody imported it before, and
# reads it again when it changes
numba.config.CACHE_DIR = os.environ.setdefault("NUMBA_CACHE_DIR", str(_cache_folder()))

FLAGS = {"reassoc", "contract", "arcp", "nsz", "afn"}
"""Floating-point liberties of all kernels. Not nnan and ninf: kernels test for non-finite input."""

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "fastmath": FLAGS,
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}

serial = numba.njit(**_OPTIONS)
"""Compile a kernel that runs on one thread."""

parallel = numba.njit(parallel=True, **_OPTIONS)
"""Compile a kernel whose prange loops run on all threads."""

inline = numba.njit(inline="always", **{k: v for k, v in _OPTIONS.items() if k != "cache"})
"""Compile a helper into the kernels that call it."""


def compile_apart(name: str, works: Sequence[Callable[[], object]]) -> None:
    """Do all works at once, each in a child process, so that what they compile is in the cache.

    A kernel that a process has compiled itself may round otherwise than the same kernel read from
    the cache: what has been compiled beside it can have become part of it. So a process whose
    results are to be those of every later one had better compile nothing. Where processes cannot
    be forked this does nothing. Nor is anything done again: ``name`` stands for the works.
    """
    done = Path(str(numba.config.CACHE_DIR)) / f"compiled-{name}"
    threads()  # starts the layer of threads, which knows whether one may fork
    if done.is_file() or not sys.platform.startswith("linux") or not may_fork():
        return
    context = multiprocessing.get_context("fork")
    children = [context.Process(target=work) for work in works]
    for child in children:
        child.start()
    for child in children:
        child.join()
    if all(child.exitcode == 0 for child in children):
        done.parent.mkdir(parents=True, exist_ok=True)
        done.touch()


def set_threads(count: int) -> int:
    """Let kernels use ``count`` threads, or all cores if 0; return how many they use."""
    most = int(numba.config.NUMBA_NUM_THREADS)
    used = min(count, most) if count > 0 else most
    numba.set_num_threads(used)
    return used


def threads() -> int:
    """Return the number of threads kernels use."""
    return int(numba.get_num_threads())


def may_fork() -> bool:
    """Tell whether kernels run in a forked process when they have threads in this one."""
    return str(numba.threading_layer()) in ("tbb", "workqueue")
