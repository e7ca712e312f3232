"""Runs commands of ours as tasks of Ray, on whatever machines see the same storage.

A task is one command that goes on where it was ended. Ray itself retries nothing: when a worker is
lost, what is left to do is looked up anew, and only the task of that worker begins again.
"""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

from gsdmsr_cli.calling.calls import INTERRUPTED, Line, failure
from gsdmsr_cli.calling.on_ray import Needs, task_of_ray
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import GsdmsrError

RETRIES = 3
"""How often a command is begun again whose worker is lost."""

_POLL_S = 0.2

_CANCEL_AGAIN_S = 10.0
"""After that time a task is cancelled once more: an interrupt in a worker can be lost [s]."""

_PAUSE_S = 1.0
"""Before a command is begun again: what the lost worker has started ends first [s]."""


@dataclass
class _Work:
    """Commands that follow each other.

    Attributes:
        log: file for what they show.
        anew: returns what is left to do.
        left: the rest of it.
        line: the command that runs.
        tries: how often it has begun.
    """

    log: Path
    anew: Callable[[], Iterator[Line]]
    left: Iterator[Line]
    line: Line = ()
    tries: int = 0


def call_on_ray(
    ray: Any,
    works: Mapping[Path, Callable[[], Iterator[Line]]],
    threads: int,
    needs: Needs,
    on_end: Callable[[Path], None],
) -> None:
    """Run several works at once, as many as the cluster has room for, each command by command.

    Args:
        ray: see ``connected``.
        works: what is left of each work, by the file that what it shows is added to.
        threads: that each command may use, and CPUs that it takes.
        needs: see ``needs_of``.
        on_end: called with that file when a work has come to its end.

    Raises:
        GsdmsrError: commands have failed; the works that they belong to ended there, others not.
        KeyboardInterrupt: Ctrl-C has ended them.
    """
    with _ctrl_c() as wanted:
        _Calls(ray, threads, needs, on_end, wanted).make(works)


class _Calls:
    """The tasks that are under way, and what has become of others."""

    def __init__(
        self,
        ray: Any,
        threads: int,
        needs: Needs,
        on_end: Callable[[Path], None],
        wanted: Callable[[], bool],
    ) -> None:
        self._ray, self._needs, self._on_end, self._wanted = ray, needs, on_end, wanted
        self._task = ray.remote(task_of_ray()).options(num_cpus=threads, max_retries=0)
        self._threads = threads
        self._running: dict[Any, _Work] = {}
        self._failures: list[str] = []
        self._interrupted = False
        self._cancelled = -math.inf

    def make(self, works: Mapping[Path, Callable[[], Iterator[Line]]]) -> None:
        """Run all works to their ends; see ``call_on_ray``."""
        try:
            for log, anew in works.items():
                self._next(_Work(log, anew, anew()))
            while self._running:
                done, _ = self._ray.wait([*self._running], timeout=_POLL_S)
                for task in done:
                    self._take(task, self._running.pop(task))
                if self._wanted():
                    self._interrupt()
        finally:
            while self._running:  # what an error leaves behind
                self._interrupt()
                for task in self._ray.wait([*self._running], timeout=_POLL_S)[0]:
                    del self._running[task]
        if self._interrupted:
            raise KeyboardInterrupt
        if self._failures:
            raise GsdmsrError("; ".join(self._failures))

    def _interrupt(self) -> None:
        """Cancel what runs, if that was not done just now."""
        now = time.monotonic()
        if now - self._cancelled < _CANCEL_AGAIN_S:
            return
        self._cancelled = now
        for task in self._running:
            self._interrupted = True
            self._ray.cancel(task)  # a KeyboardInterrupt there: a training saves what it has

    def _next(self, work: _Work) -> None:
        line = next(work.left, None)
        if line is None:
            self._on_end(work.log)
        elif not self._interrupted:
            work.line, work.tries = line, 0
            self._start(work)

    def _start(self, work: _Work) -> None:
        work.tries += 1
        given = list(work.line), str(work.log), self._threads, self._needs
        self._running[self._task.remote(*given)] = work

    def _take(self, task: Any, work: _Work) -> None:
        """Go on after a task has ended in whatever way."""
        errors = self._ray.exceptions
        try:
            host, code, lack = self._ray.get(task)
        except errors.TaskCancelledError:
            self._interrupted = True
        except errors.RayTaskError as error:
            self._failures.append(f"{work.log}: {str(error).splitlines()[-1]}")
        except errors.RayError as error:
            self._begin_again(work, f"{type(error).__name__}")
        else:
            if lack:
                self._failures.append(f"worker {host}: {lack}")
            elif code == INTERRUPTED:
                self._interrupted = True
            elif code:
                self._failures.append(failure(work.line, code, f"in {work.log}"))
            else:
                self._next(work)

    def _begin_again(self, work: _Work, reason: str) -> None:
        what = f"{work.log}: its worker is lost ({reason})"
        if self._interrupted:
            return
        if work.tries > RETRIES:
            self._failures.append(f"{what}, for the {work.tries}th time; the same command goes on")
            return
        say.warn(f"{what}; it goes on with another, {work.tries} of {RETRIES} times")
        time.sleep(_PAUSE_S)
        work.left = work.anew()
        line = next(work.left, None)
        if line is None:
            self._on_end(work.log)
            return
        work.line = line
        self._start(work)


@contextmanager
def _ctrl_c() -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether Ctrl-C has been pressed, which does nothing else."""
    presses = 0

    def press(_number: int, _frame: FrameType | None) -> None:
        nonlocal presses
        presses += 1

    earlier = signal.signal(signal.SIGINT, press)
    try:
        yield lambda: presses > 0
    finally:
        signal.signal(signal.SIGINT, earlier)
