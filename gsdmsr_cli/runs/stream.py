"""The model of a stream as far as it has come, put together from the files of its moments."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import NAMES
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.layers.newcomers import OWN, PAST, READY, TIMES
from gsdmsr_cli.model.model import MOTION
from gsdmsr_cli.runs import moments
from gsdmsr_cli.runs.checkpoints import WRONG, Checkpoint


@dataclass(frozen=True)
class Told:
    """What a moment's file says of the training at its end.

    Attributes:
        step: steps made.
        progress: of the whole stream, in [0, 1].
        elapsed: wall time of training [s].
    """

    step: int
    progress: float
    elapsed: float


def load(root: Path) -> Checkpoint:
    """Return what stands for a checkpoint: the tensors of a model of all moments that there are.

    A moment whose file is missing is left out; splats go straight past it.

    Raises:
        DataError: there is none, the first is not there, or one is damaged.
    """
    numbers = moments.there(root)
    if not numbers or numbers[0] != 0:
        raise DataError(f"{moments.path_of(root, 0)}: is not there; train again with --overwrite")
    first, *later = (moments.read(root, number) for number in numbers)
    try:
        tensors = first.tensors | _tracks(root, first, later) | _newcomers(first, later)
        told = Told(**(later or [first])[-1].about["told"])
        files = [first, *later]
        digest = hashlib.sha256("".join(file.sha256 for file in files).encode()).hexdigest()
        sizes = {name: tensor.nbytes for name, tensor in first.tensors.items()}
        sizes[f"{MOTION}.moments"] = sum(file.size for file in later)
        total = sum(file.size for file in files)
        return Checkpoint(told.step, told.progress, told.elapsed, tensors, {}, digest, total, sizes)
    except WRONG as error:
        raise DataError(
            f"{root / moments.FOLDER}: damaged: {error}; train again with --overwrite"
        ) from error


def _tracks(root: Path, first: moments.Written, later: list[moments.Written]) -> dict[str, Tensor]:
    """Return the tensors of a motion that is learnt moment after moment."""
    found = [moments.tracks_of(root, file) for file in later]
    if not found:
        count = int(first.about.get("rows", len(first.tensors["splats.means"])))
        found = [{"offsets": torch.zeros(count, 3), "turns": torch.zeros(count, 4)}]
        later = [first]
    if len({len(each["offsets"]) for each in found}) != 1:
        raise ValueError("moments of different numbers of rows")
    tensors = {f"{MOTION}.times": _times([first, *later])}
    for name in moments.TRACKS:
        last, past = _apart([each[name] for each in found])
        tensors |= {f"{MOTION}.{name}": last, f"{MOTION}.past_{name}": past}
    return tensors


def _newcomers(first: moments.Written, later: list[moments.Written]) -> dict[str, Tensor]:
    """Return the tensors of the layer ``newcomers``, none where the model lacks it."""
    if OWN + READY not in first.tensors:
        return {}
    later = later or [first]
    tensors = {OWN + TIMES: _times([first, *later])}
    for name in NAMES:
        last, past = _apart([file.tensors[OWN + name].float() for file in later])
        tensors |= {OWN + name: last, OWN + PAST + name: past}
    return tensors


def _times(files: list[moments.Written]) -> Tensor:
    return torch.tensor([float(file.about["time"]) for file in files], dtype=torch.float64)


def _apart(moments_of: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Return the last of some tensors (R, ...), and the others as one (R, K, ...)."""
    *past, last = moments_of
    return last, torch.stack(past, dim=1) if past else last[:, None][:, :0]
