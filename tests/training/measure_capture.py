"""What refined cameras and exposures are worth on a synthetic capture, in a table.

PYTHONPATH=tests python tests/training/measure_capture.py [--steps 1500] [--seeds 0 1 2]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from walking_capture import pixel_errors, write_capture

from gsdmsr_cli.evaluation.protocol import ViewRenderer, average, score_views
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.model.layers.cameras import Cameras
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.trainer import Trainer

DEVICES = {
    "neither": "[]",
    "cameras": "[{name: cameras}]",
    "exposure": "[{name: exposure}]",
    "both": "[{name: cameras}, {name: exposure}]",
}
"""Layers by what a row of the table is called."""

CAPTURES = {"as it should be": (0.0, 0.0), "poses": (1.0, 0.0), "colours": (0.0, 0.2),
            "poses and colours": (1.0, 0.2)}  # fmt: skip
"""Error of poses [px] and drift of colours by what is wrong with a capture."""


def trained(folder: Path, layers: str, steps: int, seed: int, options: list[str]) -> Trainer:
    """Return a training that has ended."""
    given = [
        f"training.steps={steps}", f"training.seed={seed}", "training.threads=1",
        "splats.count=2500", "density.cap=12000", f"layers={layers}", *options,
    ]  # fmt: skip
    preset = load_preset("dnerf", None, given)
    torch.set_num_threads(1)
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 28)
    trainer = Trainer(read_scene(folder), preset, best_engine("cpu"), pictures)
    for _ in range(steps):
        trainer.step()
    return trainer


def scores(trainer: Trainer) -> tuple[float, float, float]:
    """Return the PSNR of train, val and test views [dB]."""
    training = trainer.renderer
    renderer = ViewRenderer(
        trainer.result(), training.engine, training.pictures, training.background
    )
    found = []
    for split in ("train", "val", "test"):
        scored = score_views(renderer, trainer.scene.split(split), {}, lambda done: None)
        found.append(average([one for _, one in scored])["psnr"] or 0.0)
    return found[0], found[1], found[2]


def main() -> None:
    """Train everything and print a line each."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--steps", type=int, default=1500)
    asked.add_argument("--seeds", type=int, nargs="+", default=[0])
    asked.add_argument("--size", type=int, default=96)
    asked.add_argument("--frames", type=int, default=48)
    asked.add_argument("--captures", nargs="+", default=list(CAPTURES), choices=list(CAPTURES))
    asked.add_argument("--devices", nargs="+", default=list(DEVICES), choices=list(DEVICES))
    asked.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    args = asked.parse_args()
    print("| what is wrong | layers | camera error [px] | train | val | test, of each seed [dB] |")
    print("|---|---|---|---|---|---|", flush=True)
    for what in args.captures:
        for name in args.devices:
            lines = []
            for seed in args.seeds:
                with tempfile.TemporaryDirectory() as folder:
                    given = args.size, args.frames, *CAPTURES[what], seed
                    capture = write_capture(Path(folder), *given)
                    trainer = trained(Path(folder), DEVICES[name], args.steps, seed, args.set)
                    cameras = capture.given
                    layer = trainer.result().layers.get("layers.cameras")
                    if isinstance(layer, Cameras):
                        views = trainer.views
                        cameras = [layer.place(view.camera, view.time) for view in views]
                    error = float(np.sqrt(np.square(pixel_errors(cameras, capture)).mean()))
                    lines.append((error, *scores(trainer)))
            means = [fmean(column) for column in zip(*lines, strict=True)]
            shown = " | ".join(f"{value:.2f}" for value in means)
            each = ", ".join(f"{test:.2f}" for *_, test in lines)
            print(f"| {what} | {name} | {shown} ({each}) |", flush=True)


if __name__ == "__main__":
    main()
