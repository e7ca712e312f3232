"""A command of gsdmsr in a process of its own, killed by SIGKILL at its n-th change of a folder.

Or the disk is full from then on.

The processes are forked by a server that has imported everything and run nothing: a process whose
Numba threads have run cannot be forked, and a fresh one spends seconds on imports.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from ctypes import c_long
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

TAKE_SPACE = {"open", "os.rename", "os.mkdir", "os.link", "os.symlink", "os.fsync"}
CHANGES = {*TAKE_SPACE, "os.remove", "os.rmdir", "os.chmod"}
"""What Python tells of before it is done; ``fsync`` is added here."""

IMPORTS = "torch", "numba", "gsdmsr_cli.cli.main", "gsdmsr_cli.commands.train", "killed"

PATIENCE = 300.0
"""A command that has not ended by then hangs [s]."""


@dataclass(frozen=True)
class Ended:
    """How a command has ended.

    Attributes:
        code: exit code, negative for a signal.
        changes: how many changes of the folder it has begun.
        said: what it printed.
    """

    code: int
    changes: int
    said: str

    @property
    def killed(self) -> bool:
        return self.code == -signal.SIGKILL


def run(words: Sequence[object], folder: Path, number: int = 0, full: bool = False) -> Ended:
    """Run a command; kill it before its ``number``-th change of ``folder``, never if that is 0.

    With ``full`` it is not killed, but finds the disk full from that change on.

    Raises:
        TimeoutError: it hangs.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload([*IMPORTS])
    # what it prints goes where it changes nothing that is counted or compared
    log = folder.with_name(f".{folder.name}.log")
    changes = context.Value(c_long, 0, lock=False)
    given = [*map(str, words)], str(folder), number, full, changes, str(log)
    process = context.Process(target=_run, args=given)
    process.start()
    process.join(PATIENCE)
    if process.exitcode is None:
        process.kill()
        process.join()
        raise TimeoutError(f"{words}: has not ended; killed at change {number}")
    said = log.read_text(encoding="utf-8")
    log.unlink()
    return Ended(process.exitcode, changes.value, said)


def _run(words: list[str], folder: str, number: int, full: bool, changes: Any, log: str) -> None:
    said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    for stream in (1, 2):
        os.dup2(said, stream)
    from gsdmsr_cli.cli.main import main

    own = os.getpid()

    def count(event: str) -> None:
        if os.getpid() != own:  # a worker, which ends with its training
            return
        changes.value += 1
        if full and 0 < number <= changes.value and event in TAKE_SPACE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if not full and number == changes.value:
            os.kill(own, signal.SIGKILL)

    _at_changes(folder, count)
    sys.argv = ["gsdmsr", *words]
    main()


def _at_changes(folder: str, act: Callable[[str], None]) -> None:
    """Have ``act`` called before each change of what lies in ``folder`` or is called alike."""
    fsync = os.fsync

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        reads = event == "open" and not arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if event in CHANGES and not reads and _lies_in(arguments[0], folder):
            act(event)

    def flush(descriptor: int) -> None:
        act("os.fsync")
        fsync(descriptor)

    os.fsync = flush  # type: ignore[assignment]
    sys.addaudithook(watch)


def _lies_in(path: Any, folder: str) -> bool:
    """Return whether a path is in a folder; one relative to a descriptor is taken for such."""
    if isinstance(path, int):
        return False
    name = os.fsdecode(path)
    return name.startswith((folder, "./")) or "/" not in name
