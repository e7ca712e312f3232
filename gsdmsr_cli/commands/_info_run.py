"""Looks at a run folder, for ``gsdmsr info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsdmsr_cli.commands._found import Found
from gsdmsr_cli.evaluation import protocol
from gsdmsr_cli.formats import needs_preparing, read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.runs import moments
from gsdmsr_cli.runs.outputs import EVALUATION, METRICS
from gsdmsr_cli.runs.run import Run, open_run


def run_found(folder: Path) -> Found:
    """Return what a run is; its checkpoint and, where it is still there, its data are read."""
    try:
        run = open_run(folder)
    except DataError as error:
        return Found("run", {}, (str(error),))
    problems: list[str] = []
    facts = _described(run)
    for part in (_trained, _data):
        try:
            facts |= part(run)
        except DataError as error:
            problems.append(str(error))
    return Found("run", facts, tuple(problems))


def _described(run: Run) -> dict[str, Any]:
    training = run.preset.training
    return {
        "preset": run.name,
        "preset_reason": run.reason,
        "motion": run.preset.motion["name"],
        "length": training.budget or f"{training.steps} steps",
        "seed": training.seed,
    }


def _trained(run: Run) -> dict[str, Any]:
    model, checkpoint = run.load_model()
    log = run.read_log()
    psnr: dict[str, Any] = {
        key: log[-1][key] for key in ("val_psnr", "train_psnr") if log and key in log[-1]
    }
    return {
        "step": checkpoint.step,
        "progress": checkpoint.progress,
        "complete": checkpoint.progress >= 1,
        "trained_s": round(checkpoint.elapsed, 1),
        "splats": len(model.splats),
        "moving": model.moving,
        **_moments(run),
        **psnr,
        "checkpoint_bytes": run.checkpoint_path.stat().st_size,
        **protocol.storage(checkpoint.sizes()),
        "evaluated": (run.results / EVALUATION / METRICS).is_file(),
    }


def _moments(run: Run) -> dict[str, Any]:
    """Return how many moments of a stream are there; nothing of another run."""
    if not run.preset.stream.enabled or run.is_file:
        return {}
    return {"moments": f"{len(moments.there(run.root))} of {run.facts.frames}"}


def _data(run: Run) -> dict[str, Any]:
    """Return where the data is, and whether it is there still.

    Raises:
        DataError: what is there is not what the run was trained on, or cannot be read.
    """
    place = run.data
    if place is None:
        return {"layout": run.layout}
    there = place.is_dir()
    if there and not needs_preparing(place):
        run.part_of(read_scene(place))
    return {"data": str(place), "layout": run.layout, "data_is_there": there}
