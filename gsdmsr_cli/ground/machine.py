"""What a measurement was made on: processor, memory, versions."""

from __future__ import annotations

import os
import platform
import sys
from importlib import metadata
from pathlib import Path

from gsdmsr_cli import __version__
from gsdmsr_cli.ground.origin import commit

_PACKAGES = ("torch", "numba", "numpy")


def cache_home() -> Path:
    """Return the folder for what can be made again, such as compiled kernels.

    Whoever has no home, as a user of a container without a name, gets a path that cannot be made.
    """
    named = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        place = named if named.is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        place = Path(os.devnull).absolute()
    return place / "gsdmsr"


def cpu_name() -> str:
    """Return the processor's model as the system names it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def peak_rss_mib(workers: int = 0) -> float | None:
    """Return the most memory this process has held so far [MiB], or None where nobody counts.

    Each of the worker processes that have ended counts like the largest of them; what they share
    with this process is counted again.
    """
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if workers:
        peak += workers * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)


def versions() -> dict[str, str]:
    """Return the version and commit of gsdmsr, and Python's and those of what numbers depend on."""
    own = {"gsdmsr": __version__, "commit": commit() or "unknown"}
    packages = {name: metadata.version(name) for name in _PACKAGES}
    return {**own, "python": platform.python_version(), **packages}
