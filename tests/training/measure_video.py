"""What each device of the preset `video` is worth on a ray-traced capture of a room, in a table.

PYTHONPATH=tests python tests/training/measure_video.py [--steps 2000] [--seeds 0 1 2]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from moving_room import THINGS, Floats, Thing, seen_points, write_capture
from walking_capture import Capture, pixel_errors

from gsdmsr_cli.evaluation.protocol import ViewRenderer, average, score_views
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.model.layers.cameras import Cameras
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.trainer import Trainer

OFF = "training.window=1", "losses.ssim_until=0.3", "density.until=0.5"
"""The preset as it was before it had a window in time."""

CAMERAS, EXPOSURE = "{name: cameras}", "{name: exposure}"

DEVICES: dict[str, Sequence[str]] = {
    "none": OFF,
    "window": OFF[1:],
    "SSIM to the end": (OFF[0], OFF[2]),
    "growing until 0.7": OFF[:2],
    "flow": (*OFF, "losses.terms=[{name: flow}]"),
    "cameras": (*OFF, f"layers=[{CAMERAS}]"),
    "exposure": (*OFF, f"layers=[{EXPOSURE}]"),
    "control points": (*OFF, "motion={name: control_points}"),
    "`video`": (),
    "`video`, cameras, exposure": (f"layers=[{CAMERAS}, {EXPOSURE}]",),
}
"""Options by what a row of the table is called."""

REFERENCE, TIMES, POINTS, NEAREST = 0.5, 17, 400, 4
"""When points of surfaces are taken, at how many moments they are looked for, how many there are,
and how many of the splats next to each tell where it goes."""

OPAQUE = 0.2
"""Opacity that a splat must have for that."""


def trained(folder: Path, steps: int, seed: int, options: Sequence[str]) -> Trainer:
    """Return a training that has ended."""
    given = [
        f"training.steps={steps}", f"training.seed={seed}", "training.threads=1",
        "splats.count=4000", "density.cap=15000", *options,
    ]  # fmt: skip
    torch.set_num_threads(1)
    pictures = Pictures((0.0, 0.0, 0.0), 1, 1 << 28)
    preset = load_preset("video", None, given)
    trainer = Trainer(read_scene(folder), preset, best_engine("cpu"), pictures)
    for _ in range(steps):
        trainer.step()
    return trainer


def scores(trainer: Trainer) -> list[float]:
    """Return PSNR of the train and the val views, of the test views, and of what moves there."""
    training = trainer.renderer
    renderer = ViewRenderer(
        trainer.result(), training.engine, training.pictures, training.background
    )
    found = []
    for split in ("train", "val", "test"):
        scored = score_views(renderer, trainer.scene.split(split), {}, lambda done: None)
        means = average([one for _, one in scored])
        found.append(means["psnr"] or 0.0)
    return [*found, means["psnr_moving"] or 0.0]


@torch.no_grad()
def path_error(model: Model, thing: Thing) -> float:
    """Return how far points of a surface are from where they should be, in % of their paths."""
    points = seen_points(thing, REFERENCE, POINTS, 160)
    start = model.at(model.instant(REFERENCE)).splats
    opaque = (start.logit_opacities.sigmoid() > OPAQUE).numpy()
    places = start.means.numpy()[opaque]
    begun = thing.at(points, REFERENCE)
    near = np.linalg.norm(begun[:, None] - places, axis=2).argsort(axis=1)[:, :NEAREST]
    found: list[Floats] = []
    true: list[Floats] = []
    for time in np.linspace(0, 1, TIMES):
        moved = model.at(model.instant(float(time))).splats.means.numpy()[opaque] - places
        found.append(begun + moved[near].mean(1))
        true.append(thing.at(points, time))
    ways = np.linalg.norm(np.diff(true, axis=0), axis=2).sum(0)
    apart = np.linalg.norm(np.array(found) - np.array(true), axis=2).mean(0)
    return float(100 * (apart / ways).mean())


def camera_error(trainer: Trainer, capture: Capture) -> float:
    """Return the error of the cameras that the training ends with [px]."""
    layer = trainer.result().layers.get("layers.cameras")
    cameras = capture.given
    if isinstance(layer, Cameras):
        cameras = [layer.place(view.camera, view.time) for view in trainer.views]
    return float(np.sqrt(np.square(pixel_errors(cameras, capture)).mean()))


def main() -> None:
    """Train everything and print a line each."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--steps", type=int, default=2000)
    asked.add_argument("--seeds", type=int, nargs="+", default=[0])
    asked.add_argument("--width", type=int, default=160)
    asked.add_argument("--frames", type=int, default=48)
    asked.add_argument("--pixels", type=float, default=1.0, help="error of the poses")
    asked.add_argument("--drift", type=float, default=0.2, help="of the colours")
    asked.add_argument("--devices", nargs="+", default=list(DEVICES), choices=list(DEVICES))
    asked.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE")
    args = asked.parse_args()
    things = " | ".join(f"{name} [%]" for name in THINGS)
    print(f"| device | camera error [px] | {things} | train | val | test | moving, of each seed |")
    print("|---|---:|---:|---:|---:|---:|---:|---|", flush=True)
    for name in args.devices:
        lines = []
        for seed in args.seeds:
            with tempfile.TemporaryDirectory() as folder:
                given = args.width, args.frames, args.pixels, args.drift, seed
                capture = write_capture(Path(folder), *given)
                trainer = trained(Path(folder), args.steps, seed, [*DEVICES[name], *args.set])
                paths = [path_error(trainer.result(), thing) for thing in THINGS.values()]
                lines.append((camera_error(trainer, capture), *paths, *scores(trainer)))
        means = [fmean(column) for column in zip(*lines, strict=True)]
        shown = " | ".join(f"{value:.2f}" for value in means)
        each = ", ".join(f"{line[-1]:.2f}" for line in lines)
        print(f"| {name} | {shown} ({each}) |", flush=True)


if __name__ == "__main__":
    main()
