"""Compiles and runs kernels on the CPU and on GPUs, whatever they compute."""

from __future__ import annotations

import os
import sys

from gsdmsr_cli.ground.limits import cores


def _heed_quota() -> None:
    """Let Numba start no more threads than a container's quota keeps busy; it knows of affinity."""
    affinity = getattr(os, "sched_getaffinity", None)
    if affinity and cores() < len(affinity(0)) and "numba" not in sys.modules:
        os.environ.setdefault("NUMBA_NUM_THREADS", str(cores()))


_heed_quota()
