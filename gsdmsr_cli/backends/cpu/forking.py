"""A process that does pieces of work for another, each in a process that is forked for it alone.

What takes long to import is imported once, before the first fork, and no piece of work sees what
another has left behind.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping

IDLE_SECONDS = 10.0
"""The process ends after so long without work."""

GRACE_SECONDS = 1.0
"""The process is killed if it does not end by itself within so long."""

_LENGTH = struct.Struct("<Q")
_DONE, _FAILED = b"1", b"0"
_ASKED, _ANSWERS = 0, 1
"""Descriptors of the standard input and output."""


class Forks:
    """Gives pieces of work to such a process, which is started when there is none.

    A process that is forked from this one starts one of its own.
    """

    def __init__(self, code: str) -> None:
        """Name the Python code that the process runs: imports, then ``serve``."""
        self._code = code
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._environment: Mapping[str, str] = {}
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._leave)

    def do(self, work: bytes, environment: Mapping[str, str]) -> bool:
        """Return whether a piece of work has been done in an environment, without an error.

        Raises:
            OSError: no process can be started.
        """
        with self._lock:
            try:
                # again where there is no answer: an idle process may just have ended
                answer = self._ask(work, environment) or self._ask(work, environment)
            except BaseException:
                self._stop()  # its answer to this would be taken for that to other work
                raise
        return answer == _DONE

    def _ask(self, work: bytes, environment: Mapping[str, str]) -> bytes:
        """Return the answer to a piece of work, nothing if the process has ended."""
        if self._process is None or self._environment != environment:
            self._stop()
            self._process = subprocess.Popen(
                [sys.executable, "-c", self._code],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
            self._environment = dict(environment)
        given, answers = self._process.stdin, self._process.stdout
        assert given is not None and answers is not None
        answer = b""
        with contextlib.suppress(BrokenPipeError):
            given.write(_LENGTH.pack(len(work)) + work)
            given.flush()
            answer = answers.read(1)
        if not answer:
            self._stop()
        return answer

    def _stop(self) -> None:
        """Have the process end, which ends what it has forked first."""
        process = self._process
        self._close()
        if process is not None:
            try:
                process.wait(GRACE_SECONDS)
            except subprocess.TimeoutExpired:  # it is still importing, or hangs
                process.kill()
                process.wait()

    def _leave(self) -> None:
        """Leave the process to the one that has started it, of which this one is a fork."""
        self._lock = threading.Lock()  # it may have been held by a thread that is not here
        self._close()

    def _close(self) -> None:
        process, self._process = self._process, None
        for pipe in () if process is None else (process.stdin, process.stdout):
            with contextlib.suppress(BrokenPipeError):
                assert pipe is not None
                pipe.close()


def serve(work: Callable[[bytes], object]) -> None:
    """Do what the standard input asks for until it ends, or nothing has come for a while.

    Where processes cannot be forked, the first piece of work is done here, and is the last.
    """
    can_fork = hasattr(os, "fork")
    while not can_fork or select.select([_ASKED], [], [], IDLE_SECONDS)[0]:
        header = _read(_LENGTH.size)
        if len(header) < _LENGTH.size:
            return
        given = _read(*_LENGTH.unpack(header))
        done = _in_a_fork(work, given) if can_fork else _is_done(work, given)
        os.write(_ANSWERS, _DONE if done else _FAILED)
        if not can_fork:
            return


def _read(count: int) -> bytes:
    """Return so many bytes of what is asked, fewer where that ends."""
    parts = []
    while count and (part := os.read(_ASKED, count)):
        parts.append(part)
        count -= len(part)
    return b"".join(parts)


def _is_done(work: Callable[[bytes], object], given: bytes) -> bool:
    try:
        work(given)
    except BaseException:
        return False
    return True


def _in_a_fork(work: Callable[[bytes], object], given: bytes) -> bool:
    """Return whether a process that is forked for it has done a piece of work.

    It is killed when there is nobody left who waits for the answer.
    """
    ended, held = os.pipe()  # the fork holds one end, so that the other tells when it has ended
    pid = os.fork()
    if not pid:
        os.close(ended)
        os._exit(0 if _is_done(work, given) else 1)
    os.close(held)
    # while an answer is waited for, nothing but the end is to be read from who has asked
    if ended not in select.select([_ASKED, ended], [], [])[0]:
        os.kill(pid, signal.SIGKILL)
    os.close(ended)
    return os.waitpid(pid, 0)[1] == 0
