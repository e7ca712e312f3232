"""Watches what a long command holds: memory, shared memory, open files and processes."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.calling.calls import start
from gsdmsr_cli.ground.errors import GsdmsrError

PROC = Path("/proc")
"""Where Linux tells of processes."""


@dataclass(frozen=True)
class Sample:
    """What a command and all processes that it has started hold at a moment.

    Attributes:
        elapsed_s: since its start [s].
        memory_mib: resident memory of their own; what several share counts once, and pages of
            files, such as libraries, do not count [MiB].
        shared_mib: resident memory that is meant to be shared, as that of workers [MiB].
        files: open files, pipes and sockets.
        processes: how many there are.
    """

    elapsed_s: float
    memory_mib: float
    shared_mib: float
    files: float
    processes: float


def watch(command: Sequence[str], every_s: float) -> list[Sample]:
    """Run ``gsdmsr`` with these arguments to its end and return a sample of every ``every_s``.

    Its output goes to stderr.

    Raises:
        GsdmsrError: this system does not tell of processes, or the command has failed.
    """
    if not (PROC / "self" / "smaps_rollup").exists():
        raise GsdmsrError(f"{PROC}/self/smaps_rollup is not there; memory is counted on Linux only")
    samples, began = list[Sample](), time.perf_counter()
    with start(command, sys.stderr.fileno()) as process:
        try:
            while _runs(process, every_s):
                samples.append(take_sample(process.pid, time.perf_counter() - began))
        except BaseException:
            process.send_signal(signal.SIGINT)
            raise
    if process.returncode:
        raise GsdmsrError(f"gsdmsr {command[0]} has failed with exit code {process.returncode}")
    return samples


def _runs(process: subprocess.Popen[bytes], seconds: float) -> bool:
    with suppress(subprocess.TimeoutExpired):
        process.wait(seconds)
    return process.returncode is None


def take_sample(root: int, elapsed_s: float) -> Sample:
    """Return what process ``root`` and its descendants hold now; one that ends counts as nothing.

    Memory is the proportional set size of /proc/PID/smaps_rollup: a page that n processes share
    counts 1 / n in each.
    """
    memory = shared = files = 0.0
    family = _family(root)
    for pid in family:
        with suppress(OSError):
            sizes = (PROC / str(pid) / "smaps_rollup").read_text(encoding="ascii")
            memory += _mib(sizes, "Pss_Anon")
            shared += _mib(sizes, "Pss_Shmem")
            files += sum(1 for _ in (PROC / str(pid) / "fd").iterdir())
    return Sample(elapsed_s, memory, shared, files, len(family))


def _family(root: int) -> list[int]:
    found = [root]
    for pid in found:  # grows while it is gone through
        with suppress(OSError):
            for children in (PROC / str(pid) / "task").glob("*/children"):
                found += map(int, children.read_text(encoding="ascii").split())
    return found


def _mib(sizes: str, name: str) -> float:
    found = re.search(rf"^{name}:\s+(\d+) kB$", sizes, re.MULTILINE)
    return int(found[1]) / 1024 if found else 0.0


def tenths(samples: Sequence[Sample]) -> list[Sample]:
    """Return the median of each tenth of the samples, in order; fewer where there are fewer."""
    return [_median(part) for part in _parts(samples, 10)]


def largest(samples: Sequence[Sample]) -> Sample:
    """Return the largest of each quantity, and at ``elapsed_s`` the length of all."""
    return Sample(*np.max([astuple(sample) for sample in samples], axis=0).tolist())


def growth(samples: Sequence[Sample]) -> Sample:
    """Return by how much each quantity has grown from the third quarter to the last, per hour.

    Before, there is other work: kernels are loaded, pictures kept, splats become more. Medians of
    the quarters are compared, or the moment in which the command ends would count.

    Raises:
        GsdmsrError: there are fewer than four samples.
    """
    if len(samples) < 4:
        raise GsdmsrError("the command has ended before four samples; lower --every")
    *_, third, last = (np.array(astuple(_median(part))) for part in _parts(samples, 4))
    slopes = (last - third) / ((last[0] - third[0]) / 3600)
    return Sample(*slopes.tolist())


def _parts(samples: Sequence[Sample], count: int) -> list[NDArray[np.float64]]:
    """Return equal parts of the samples, (S, 5) each, without those that would be empty."""
    table = np.array([astuple(sample) for sample in samples])
    return [part for part in np.array_split(table, count) if len(part)]


def _median(part: NDArray[np.float64]) -> Sample:
    return Sample(*np.median(part, axis=0).tolist())
