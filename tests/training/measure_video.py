"""What each device of the preset `video` is worth on a ray-traced capture of a room, in a table.

PYTHONPATH=tests python tests/training/measure_video.py [--steps 2000] [--seeds 0 1 2]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from measured_captures import camera_error, print_row, scores, trained
from moving_room import THINGS, Floats, Thing, seen_points, write_capture

from gsdmsr_cli.model.model import Model

OFF = "training.window=1", "losses.ssim_until=0.3", "density.until=0.5"
"""The preset as it was before it had a window in time."""

EVENTS = "density, opacity_reset, thinning, stillness"
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
    "motion masks": (*OFF, f"events=[{EVENTS}, motion_masks]"),
    "`video`": (),
    "`video`, cameras, exposure": (f"layers=[{CAMERAS}, {EXPOSURE}]",),
}
"""Options by what a row of the table is called."""

SMALL = "splats.count=4000", "density.cap=15000"

REFERENCE, TIMES, POINTS, NEAREST = 0.5, 17, 400, 4
"""When points of surfaces are taken, at how many moments they are looked for, how many there are,
and how many of the splats next to each tell where it goes."""

OPAQUE = 0.2
"""Opacity that a splat must have for that."""


@torch.no_grad()
def path_error(model: Model, thing: Thing) -> float:
    """Return how far points of a surface are from where they should be, in % of their paths."""
    points = seen_points(thing, REFERENCE, POINTS)
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
                options = [*SMALL, *DEVICES[name], *args.set]
                trainer = trained(Path(folder), "video", 0.0, args.steps, seed, options)
                paths = [path_error(trainer.result(), thing) for thing in THINGS.values()]
                seen = [*scores(trainer, "train", "psnr"), *scores(trainer, "val", "psnr")]
                aside = scores(trainer, "test", "psnr", "psnr_moving")
                lines.append([camera_error(trainer, capture), *paths, *seen, *aside])
        print_row([name], lines)


if __name__ == "__main__":
    main()
