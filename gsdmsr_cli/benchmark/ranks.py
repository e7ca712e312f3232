"""Runs a training by torchrun, and kills one of its ranks on the way. Linux only."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from gsdmsr_cli.ground.errors import GsdmsrError

_RESTARTS = 3
"""How often all ranks may be started anew; one kill needs one."""

_POLL_S = 0.02


def train_in_ranks(
    line: Sequence[str], ranks: int, log: Path, kill_after_s: float, chance: random.Random
) -> None:
    """Run a command of ours as so many ranks of torchrun until they have ended.

    Args:
        line: the command line, without the program's name.
        ranks: how many.
        log: file that all they show is added to.
        kill_after_s: one rank is killed so long after torchrun has been started, or as soon as
            there are ranks; infinity kills none.
        chance: which rank that is.

    Raises:
        GsdmsrError: torchrun has failed.
    """
    how = ["--standalone", "--nproc-per-node", str(ranks), "--max-restarts", str(_RESTARTS)]
    command = [sys.executable, "-m", "torch.distributed.run", *how, "-m", "gsdmsr_cli", *line]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as shown:
        process = subprocess.Popen(command, stdout=shown, stderr=shown, start_new_session=True)
    try:
        _kill_one(process, kill_after_s, chance)
        code = process.wait()
    finally:
        if process.poll() is None:  # Ctrl-C: torchrun ends its ranks
            process.send_signal(signal.SIGTERM)
            process.wait()
    if code:
        raise GsdmsrError(f"torchrun has failed with exit code {code}, its messages are in {log}")


def _kill_one(process: subprocess.Popen[bytes], after_s: float, chance: random.Random) -> None:
    end = time.monotonic() + after_s
    while process.poll() is None:
        found = ranks_of(process.pid) if time.monotonic() >= end else []
        if found:
            with suppress(ProcessLookupError):  # it has just ended
                os.kill(chance.choice(found), signal.SIGKILL)
            return
        time.sleep(_POLL_S)


def ranks_of(torchrun: int) -> list[int]:
    """Return the ids of the processes that a torchrun has started as ranks."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            started = b"gsdmsr_cli" in (folder / "cmdline").read_bytes()
            found += [int(folder.name)] if int(parent) == torchrun and started else []
    return sorted(found)
