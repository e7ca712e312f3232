"""How every kernel is compiled: options, threads, and an on-disk cache that notices edits.

A kernel that is not in the cache is compiled by a process of its own, which starts for nothing
else, and is then read from there. A process that compiles a kernel itself can get other code than
one that reads it, which rounds otherwise: so a training's results would depend on what had been
trained before.
"""

from __future__ import annotations

import ctypes
import hashlib
import importlib
import itertools
import os
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

from gsdmsr_cli.backends.cpu.forking import Forks
from gsdmsr_cli.backends.kernel_folder import choose_folder
from gsdmsr_cli.ground.machine import cache_home

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

HERE = Path(__file__).parent
PACKAGE = HERE.parents[1]


def sources() -> list[Path]:
    """Return all files that kernels are compiled from: their own, and the constants."""
    ops = PACKAGE / "ops"
    kernels = [*ops.glob("*/cpu.py"), *ops.glob("*/cpu/*.py"), *HERE.glob("*.py")]
    constants = [PACKAGE / "ground" / name for name in ("splatting_constants.py", "ssim.py")]
    return [*sorted(kernels), *constants]


def _sources_hash() -> str:
    digest = hashlib.sha256()
    for path in sources():
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Folder of compiled kernels: what the user names, beside the sources, or the user's cache.

    Numba alone would not recompile a kernel when a helper in another module changes, so the
    folder's name is a hash of all kernel sources and of the constants compiled into them.
    """
    if named := os.environ.get("NUMBA_CACHE_DIR"):
        return choose_folder([Path(named)])
    name = _sources_hash()
    return choose_folder([HERE / "__pycache__" / name, cache_home() / name])


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
from numba.core.bytecode import FunctionIdentity  # noqa: E402
from numba.core.caching import FunctionCache, IndexDataCacheFile  # noqa: E402


def _keep_tbb_loaded() -> None:
    """Let Numba's part that uses TBB never be unloaded.

    When it is, at the end of a process, it waits for a task that TBB's threads were to run. On a
    single core there are none, and it may wait forever.
    """
    try:
        tbbpool = importlib.import_module("numba.np.ufunc.tbbpool")
    except ImportError:
        return
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(tbbpool))


_keep_tbb_loaded()

# set in both places: Numba has read its environment already if anybody imported it before, and
# reads it again when it changes
numba.config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = str(_cache_folder())

FLAGS = {"reassoc", "contract", "arcp", "nsz", "afn"}
"""Floating-point liberties of all kernels. Not nnan and ninf: kernels test for non-finite input."""

_OPTIONS: dict[str, Any] = {
    "cache": True,
    "fastmath": FLAGS,
    "error_model": "numpy",
    "boundscheck": False,
    "nogil": True,
}

_compilers = Forks(
    "from gsdmsr_cli.backends.cpu import forking, jit; forking.serve(jit.compile_one)"
)
"""Processes that compile a kernel each."""

_compiles_here: set[tuple[str, str]] = set()
"""Module and name of the kernel that this process is there to compile."""


class Entries(IndexDataCacheFile):  # type: ignore[misc]
    """Numba's index and files of a kernel, with a file's name made of what it holds.

    Numba numbers the files. Two processes that add to an index at once, one of which may be left
    of a training that was killed, then take the same number, and the index says of one's code that
    it is the other's: a kernel for other types, which runs and computes something else.
    """

    def save(self, key: Any, data: Any) -> None:
        """Save a kernel, and then that it is there; of two at once one may be forgotten."""
        told = repr((key, self._source_stamp)).encode()
        digest = hashlib.sha256(told).hexdigest()[:16]
        name = self._data_name_pattern.replace("{number:d}", digest)
        self._save_data(name, data)
        self._save_index(self._load_index() | {key: name})


class _Cache(FunctionCache):  # type: ignore[misc]
    """Numba's cache on disk, which has what is missing compiled by another process."""

    def __init__(self, kernel: Callable[..., Any]) -> None:
        super().__init__(kernel)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file = Entries(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Return the compiled kernel, or None where this process has to compile it itself."""
        # Numba starts its threads before it loads a parallel kernel, but not before a serial one
        # that calls such, which would then call what is not there
        numba.get_num_threads()
        found = super().load_overload(signature, target)
        if found is not None or not self._can_be_imported():
            return found
        with self._locked():
            found = super().load_overload(signature, target)  # it may have been compiled meanwhile
            if found is None and _compile_apart(*self._kernel(), signature):
                found = super().load_overload(signature, target)
        return found

    def save_overload(self, signature: Any, data: Any) -> None:
        """Keep a compiled kernel; where the disk is full, the next process compiles it again."""
        with suppress(OSError):
            super().save_overload(signature, data)

    def _kernel(self) -> tuple[str, str]:
        return self._py_func.__module__, self._py_func.__qualname__

    def _can_be_imported(self) -> bool:
        """Return whether the kernel has a name by which another process can compile it."""
        module, name = self._kernel()
        return name.isidentifier() and module != "__main__" and (module, name) not in _compiles_here

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Let one process at a time add to the kernel's index, which Numba reads and writes."""
        folder = Path(self.cache_path)
        with ExitStack() as held:
            with suppress(OSError):  # as where the disk is full, and nothing is added
                folder.mkdir(parents=True, exist_ok=True)
                path = folder / f"{self._impl.filename_base}.lock"
                file = held.enter_context(path.open("w"))
                if fcntl is not None:
                    fcntl.flock(file, fcntl.LOCK_EX)
            yield


def _compile_apart(module: str, name: str, signature: Any) -> bool:
    """Have another process compile a kernel into the cache; return whether it has."""
    # seeded, since sets of names must not come in another order each time
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(numba.config.CACHE_DIR),
        "PYTHONHASHSEED": "0",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    try:
        return _compilers.do(pickle.dumps((module, name, signature)), environment)
    except OSError:
        return False


def compile_one(asked: bytes) -> None:
    """Compile a kernel, in a process that does nothing else; see ``_compile_apart``."""
    for folder in (PACKAGE / "ops").iterdir():
        if folder.is_dir():
            # an operation's own module brings torch, which takes longer than most kernels
            empty = ModuleType(f"{PACKAGE.name}.ops.{folder.name}")
            empty.__path__ = [str(folder)]
            sys.modules[empty.__name__] = empty
    _take_names_of_its_own(asked)
    module, name, signature = pickle.loads(asked)
    _compiles_here.add((module, name))
    getattr(importlib.import_module(module), name).compile(signature)


def _take_names_of_its_own(asked: bytes) -> None:
    """Let no other process give the same names to the parts of what is compiled here.

    Numba names the loops of a kernel by an address and a count, which forks of one process have in
    common. Of two forms of a kernel whose loops have the same name, such as for three channels and
    for four, whoever loads both runs the loops of the first for either.
    """
    first = int(hashlib.sha256(asked).hexdigest()[:12], 16)
    FunctionIdentity._unique_ids = itertools.count(first)


def _kept(compiled: Any) -> Any:
    """Give a kernel the cache whose misses are compiled apart."""
    compiled._cache = _Cache(compiled.py_func)
    return compiled


def serial(kernel: Callable[..., Any]) -> Any:
    """Compile a kernel that runs on one thread."""
    return _kept(numba.njit(**_OPTIONS)(kernel))


def parallel(kernel: Callable[..., Any]) -> Any:
    """Compile a kernel whose prange loops run on all threads."""
    return _kept(numba.njit(parallel=True, **_OPTIONS)(kernel))


inline = numba.njit(inline="always", **{k: v for k, v in _OPTIONS.items() if k != "cache"})
"""Compile a helper into the kernels that call it."""


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
    """Return whether kernels run in a forked process when they have threads in this one."""
    return str(numba.threading_layer()) in ("tbb", "workqueue")
