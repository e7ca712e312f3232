"""What scripts share that train on a synthetic capture and print a table of how it went."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from walking_capture import Capture, pixel_errors

from gsdmsr_cli.evaluation.protocol import ViewRenderer, average, score_views
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.model.layers.cameras import Cameras
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.trainer import Trainer


def trained(
    folder: Path, preset: str, grey: float, steps: int, seed: int, options: Sequence[str]
) -> Trainer:
    """Return a training that has ended, on one thread, before a background of a grey in [0, 1]."""
    given = [f"training.steps={steps}", f"training.seed={seed}", "training.threads=1", *options]
    torch.set_num_threads(1)
    pictures = Pictures((grey, grey, grey), 1, 1 << 28)
    loaded = load_preset(preset, None, given)
    trainer = Trainer(read_scene(folder), loaded, best_engine("cpu"), pictures)
    for _ in range(steps):
        trainer.step()
    return trainer


def scores(trainer: Trainer, split: str, *metrics: str) -> list[float]:
    """Return the means of metrics over the views of a split; 0 of one that it does not have."""
    training = trainer.renderer
    renderer = ViewRenderer(
        trainer.result(), training.engine, training.pictures, training.background
    )
    scored = score_views(renderer, trainer.scene.split(split), {}, lambda done: None)
    means = average([one for _, one in scored])
    return [means[metric] or 0.0 for metric in metrics]


def camera_error(trainer: Trainer, capture: Capture) -> float:
    """Return the error of the cameras that the training ends with, root mean square [px]."""
    layer = trainer.result().layers.get("layers.cameras")
    cameras = capture.given
    if isinstance(layer, Cameras):
        cameras = [layer.place(view.camera, view.time) for view in trainer.views]
    return float(np.sqrt(np.square(pixel_errors(cameras, capture)).mean()))


def print_row(names: Sequence[str], lines: Sequence[Sequence[float]]) -> None:
    """Print a row of the means over lines, one a seed, and of each the last value."""
    means = [fmean(column) for column in zip(*lines, strict=True)]
    shown = " | ".join([*names, *(f"{value:.2f}" for value in means)])
    each = ", ".join(f"{line[-1]:.2f}" for line in lines)
    print(f"| {shown} ({each}) |", flush=True)
