"""Work in a fork of this process, killed at a call that changes the disk, or at a byte."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

CALLS = "open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.link", "os.chmod"
"""What Python tells of before it is done."""


def killed(work: Callable[[], object], arrange: Callable[[], object]) -> bool:
    """Do work in a fork that has arranged its end; return whether it was killed in it."""
    pid = os.fork()
    if not pid:
        try:
            arrange()
            work()
        finally:
            os._exit(0)
    return os.WIFSIGNALED(os.waitpid(pid, 0)[1])


def at_call(number: int, root: Path) -> Callable[[], None]:
    """Return what lets a process be killed before its call of this number for the folder."""
    left = [number]

    def count() -> None:
        left[0] -= 1
        if left[0] < 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event in CALLS and str(root) in str(arguments[0]):
            count()

    def arrange() -> None:
        fsync = os.fsync
        os.fsync = lambda descriptor: (count(), fsync(descriptor))  # type: ignore[assignment]
        sys.addaudithook(watch)

    return arrange


def at_byte(number: int, fatal: bool) -> Callable[[], None]:
    """Return what lets no file grow beyond so many bytes: the process is killed, or told."""

    def arrange() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_DFL if fatal else signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (number, number))

    return arrange


def kill_everywhere(work: Callable[[], object], root: Path, check: Callable[[], None]) -> int:
    """Kill the work before each of its calls, one after the other; return how many there are."""
    number = 0
    while killed(work, at_call(number, root)):
        check()
        number += 1
    return number
