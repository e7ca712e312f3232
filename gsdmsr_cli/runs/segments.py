"""The runs of segments of time in a run folder, and the checkpoint that joins their models.

RUN/segments/dnerf.yaml    all options of the segments' trainings
RUN/segments/static        the run of what stands still, which the others begin with
RUN/segments/000, 001 ...  a run for each segment, which can be used like any other
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.joined import Joined, name_in
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.model import MOVING, Model
from gsdmsr_cli.model.parameter import below
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.runs.checkpoints import WRONG, Checkpoint
from gsdmsr_cli.scene.segments import Segment

FOLDER, STATIC = "segments", "static"
"""In a run folder, and the run within it of what stands still."""

_STATE = "segments"


def folder_of(root: Path, number: int) -> Path:
    """Return the run folder of a segment of the run folder ``root``."""
    return root / FOLDER / f"{number:03d}"


def static_of(root: Path) -> Path:
    """Return the run folder of what stands still."""
    return root / FOLDER / STATIC


def remove(root: Path) -> None:
    """Remove the runs of all segments, with all that has been made of them.

    Raises:
        OSError: something cannot be removed.
    """
    folder = root / FOLDER
    if folder.is_dir() and not folder.is_symlink():
        shutil.rmtree(folder)


def join(
    segments: Sequence[Segment],
    models: Sequence[Model],
    of: Sequence[tuple[Facts, Checkpoint]],
    begun_with: Checkpoint | None,
) -> Checkpoint:
    """Return the checkpoint of all segments' models together; it can be drawn, not trained further.

    Args:
        segments: in their order.
        models: of the segments.
        of: what each model has been loaded with.
        begun_with: the last checkpoint of what stands still, if all have begun with it; it counts
            for steps and time.
    """
    tensors = Joined(segments, models).tensors()
    for i, (_, checkpoint) in enumerate(of):
        if MOVING in checkpoint.tensors:
            tensors[name_in(i, MOVING)] = checkpoint.tensors[MOVING]
    told = [
        {**asdict(segment), "facts": asdict(facts), "progress": checkpoint.progress}
        for segment, (facts, checkpoint) in zip(segments, of, strict=True)
    ]
    every = [checkpoint for _, checkpoint in of]
    progress = min(checkpoint.progress for checkpoint in every)
    every += [] if begun_with is None else [begun_with]
    steps = sum(checkpoint.step for checkpoint in every)
    elapsed = sum(checkpoint.elapsed for checkpoint in every)
    return Checkpoint(steps, progress, elapsed, tensors, {_STATE: told})


def load(root: Path, checkpoint: Checkpoint, preset: Preset) -> Joined:
    """Return the model of a checkpoint that ``join`` has made.

    Raises:
        DataError: it is not one, or does not fit to the options.
    """
    try:
        told: list[dict[str, Any]] = checkpoint.state[_STATE]
        segments = [Segment(float(each["start"]), float(each["end"])) for each in told]
        models = [
            load_model(
                below(name_in(i, ""), checkpoint.tensors),
                preset.motion,
                preset.layers,
                strict.build(Facts, each["facts"], "facts"),
                float(each["progress"]),
                preset.training.precision,
            )
            for i, each in enumerate(told)
        ]
    except WRONG as error:
        raise DataError(f"{root}: damaged: {error}; go on with train --resume") from error
    return Joined(segments, models)
