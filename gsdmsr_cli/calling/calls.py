"""Runs commands of ours in processes of their own, one by one or side by side."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.parent import end_with_parent

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C has ended."""

Line = Sequence[str]
"""A command line of ours, without the program's name."""

_POLL_S = 0.1


def call(*line: str) -> None:
    """Run a command; what it shows goes to stderr, and Ctrl-C is handed on to it.

    Raises:
        GsdmsrError: it has failed; its own message stands above.
        KeyboardInterrupt: Ctrl-C has ended it.
    """
    process = start(line, sys.stderr.fileno())
    interrupted = False
    while True:
        try:
            code = process.wait()
            break
        except KeyboardInterrupt:
            interrupted = True
            process.send_signal(signal.SIGINT)
    if interrupted or code == INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        raise GsdmsrError(failure(line, code, "above"))


def call_side_by_side(works: Mapping[Path, Iterator[Line]], threads: int) -> None:
    """Run several works at once, each of them command by command; Ctrl-C is handed on to all.

    Args:
        works: the commands of each work, by the file that what they show is added to.
        threads: that each command may use.

    Raises:
        GsdmsrError: commands have failed; the works that they belong to ended there, others not.
        KeyboardInterrupt: Ctrl-C has ended them.
    """
    running: dict[Path, tuple[Line, subprocess.Popen[bytes]]] = {}
    waiting, failures = list(works), list[str]()
    presses = handed_on = 0

    def press(_number: int, _frame: FrameType | None) -> None:
        nonlocal presses
        presses += 1

    def interrupt() -> None:
        for _, process in running.values():
            process.send_signal(signal.SIGINT)

    earlier = signal.signal(signal.SIGINT, press)  # an exception could fall between start and note
    try:
        while running or (waiting and not presses):
            while waiting and not presses:
                log = waiting.pop(0)
                line = next(works[log], None)
                if line is not None:
                    running[log] = line, start_logged(line, log, threads)
            time.sleep(_POLL_S)
            if presses > handed_on:
                handed_on = presses
                interrupt()
            for log, (line, process) in list(running.items()):
                code = process.poll()
                if code is None:
                    continue
                del running[log]
                if code == INTERRUPTED:
                    presses = handed_on = presses or 1
                elif code:
                    failures.append(failure(line, code, f"in {log}"))
                else:
                    waiting.append(log)
    finally:
        interrupt()  # of what an error leaves behind; else nothing runs any more
        for _, process in running.values():
            process.wait()
        signal.signal(signal.SIGINT, earlier)
    if presses:
        raise KeyboardInterrupt
    if failures:
        raise GsdmsrError("; ".join(failures))


def start_logged(
    line: Line, log: Path, threads: int, ends_with_us: bool = False
) -> subprocess.Popen[bytes]:
    """Start a command that adds all it shows to a file, see ``start``."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as shown:
        return start(line, shown.fileno(), threads, ends_with_us)


def start(
    line: Line, shown: int, threads: int = 0, ends_with_us: bool = False
) -> subprocess.Popen[bytes]:
    """Start a command that writes all it shows to the file descriptor ``shown``.

    Args:
        line: the command line.
        shown: the file descriptor.
        threads: that it may use, 0 for all.
        ends_with_us: whether it is killed when this process is; not on Windows.
    """
    command = [sys.executable, "-m", "gsdmsr_cli", *line]
    limit = {"NUMBA_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)} if threads else {}
    # In a session of its own, or a terminal would interrupt it as well: a second Ctrl-C, at which
    # a training no longer waits to save what it has.
    return subprocess.Popen(
        command, stdout=shown, stderr=shown, start_new_session=True, env=os.environ | limit,
        preexec_fn=partial(_depend_on, os.getpid()) if ends_with_us else None,
    )  # fmt: skip


def _depend_on(parent: int) -> None:
    """Let a command end with its parent, and hear Ctrl-C, which Ray's workers block."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    end_with_parent(parent)


def failure(line: Line, code: int, where: str) -> str:
    """Return what is said of a command that has failed."""
    return (
        f"gsdmsr {line[0]} has failed with exit code {code}, its message stands {where}; what is "
        "finished stays, and the same command goes on from there"
    )
