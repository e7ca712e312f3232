"""Kills trainings at random moments and goes on: do they end where one left alone ends?"""

from __future__ import annotations

import math
import random
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsdmsr_cli.benchmark.ranks import train_in_ranks
from gsdmsr_cli.calling.calls import call
from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import is_run, open_run

OFTEN = "training.checkpoint_minutes=0.02"
"""A checkpoint a second, so that kills fall into the writing of one as well."""


@dataclass(frozen=True)
class Kill:
    """What became of a training that was killed.

    Attributes:
        after_s: wall time from its start, loading included, to the SIGKILL [s].
        step: of the checkpoint it went on from; None if it had to begin anew, or with several ranks
            if it had ended before.
        identical: whether it ended bit by bit like the one that was left alone.
    """

    after_s: float
    step: int | None
    identical: bool


def survive(
    options: Sequence[str],
    root: Path,
    kills: int,
    seed: int,
    on_kill: Callable[[Kill], None],
    ranks: int = 1,
) -> list[Kill]:
    """Train once undisturbed, then ``kills`` times with a SIGKILL, and compare the ends.

    With several ranks one of them is killed, and torchrun goes on by itself.

    Args:
        options: of ``gsdmsr train``, all but ``--out``; their length must be a number of steps.
        root: folder of the runs.
        kills: how many trainings to kill, each at a moment chosen evenly from the first's duration.
        seed: of those moments.
        on_kill: called after each.
        ranks: of torchrun; 1 goes without it.

    Raises:
        DataError: the folder ``root`` is in use.
        GsdmsrError: a training has failed by itself.
    """
    if root.exists() and any(root.iterdir()):
        raise DataError(f"{root}: is not empty; choose another --out, or remove it")
    line, moments = [*options, "--set", OFTEN], random.Random(seed)
    began = time.perf_counter()
    call("train", *line, "--out", str(root / "undisturbed"))
    expected = open_run(root / "undisturbed").load()
    if ranks > 1:
        began = time.perf_counter()
        _train_ranks(line, root / "undisturbed-ranks", ranks, math.inf, moments)
        if not same(open_run(root / "undisturbed-ranks").load(), expected):
            raise GsdmsrError(f"{ranks} ranks have ended otherwise than one process, see {root}")
    duration = time.perf_counter() - began
    found = []
    for number in range(kills):
        folder, after_s = root / f"killed-{number}", moments.uniform(0, duration)
        if ranks > 1:
            _train_ranks(line, folder, ranks, after_s, moments)
            step = open_run(folder).restarted_at
        else:
            _train_and_kill([*line, "--out", str(folder)], after_s)
            step = _go_on(line, folder)
        identical = same(open_run(folder).load(), expected)
        found.append(Kill(after_s, step, identical))
        on_kill(found[-1])
    return found


def _train_and_kill(line: Sequence[str], after_s: float) -> None:
    command = [sys.executable, "-m", "gsdmsr_cli", "train", *line]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        code = process.wait(timeout=after_s)
    except subprocess.TimeoutExpired:
        code = 0
    finally:
        process.kill()  # its workers notice, and end
        process.wait()
    if code:
        raise GsdmsrError(f"gsdmsr train has failed by itself, with exit code {code}")


def _train_ranks(
    line: Sequence[str], folder: Path, ranks: int, after_s: float, chance: random.Random
) -> None:
    """Train by torchrun, which begins again by itself when a rank has been killed."""
    log = folder.with_name(f"{folder.name}.log")
    train_in_ranks(["train", *line, "--out", str(folder)], ranks, log, after_s, chance)


def _go_on(line: Sequence[str], folder: Path) -> int | None:
    """Finish a training that has been killed; return the step it goes on from, None if anew."""
    saved = _saved(folder)
    if saved is None or saved.progress < 1:
        how = "--overwrite" if saved is None else "--resume"
        call("train", *line, "--out", str(folder), how)
    return None if saved is None else saved.step


def _saved(folder: Path) -> Checkpoint | None:
    if not is_run(folder) or not open_run(folder).checkpoint_path.is_file():
        return None
    return open_run(folder).load()


def same(found: Checkpoint, expected: Checkpoint) -> bool:
    """Return whether two checkpoints are the same in all but the wall time that they took."""
    alike = (found.step, found.state) == (expected.step, expected.state)
    names = found.tensors.keys() == expected.tensors.keys()
    if not (alike and names):
        return False
    return all(_bits(t) == _bits(expected.tensors[name]) for name, t in found.tensors.items())


def _bits(tensor: Tensor) -> tuple[torch.dtype, torch.Size, bytes]:
    return tensor.dtype, tensor.shape, tensor.contiguous().numpy().tobytes()
