"""How well what moves is masked, by optical flow alone and with a model of what stands, in a table.

PYTHONPATH=tests python tests/training/measure_masks.py [--steps 1500] [--seeds 0 1 2]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from measured_captures import trained
from moving_room import write_capture
from numpy.typing import NDArray

from gsdmsr_cli.capture import second_masks
from gsdmsr_cli.capture.masks import read_mask
from gsdmsr_cli.capture.second_masks import with_masks, write_second_masks
from gsdmsr_cli.commands._standing import standing_of
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.scene.scene import MOVING
from gsdmsr_cli.training.trainer import Trainer

OPTIONS = "splats.count=6000", "density.cap=20000"
WAYS: Mapping[str, Mapping[str, float]] = {
    "flow, as `--auto-mask`": {"DIFFERENT": np.inf, "ENOUGH": 0.999},
    "colours": {"OFF": np.inf, "ENOUGH": 0.999},
    "both, as `--masks-of`": {},
}
"""What is changed of the constants of ``capture.second_masks``."""


def main() -> None:
    """Train, mask, compare with the truth, and print a line each."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--steps", type=int, default=1500)
    asked.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    asked.add_argument("--width", type=int, default=320)
    asked.add_argument("--frames", type=int, default=48)
    args = asked.parse_args()
    rows: dict[str, list[NDArray[np.float64]]] = {way: [] for way in WAYS}
    for seed in args.seeds:
        with tempfile.TemporaryDirectory() as folder:
            write_capture(Path(folder), args.width, args.frames, 1.0, 0.2, seed)
            trainer = trained(Path(folder), "static-video", 0.0, args.steps, seed, OPTIONS)
            for way, changes in WAYS.items():
                rows[way].append(np.mean(list(judged(trainer, changes)), axis=0))
    print("| masks by | overlap (IoU) | precision | recall | overlap of each seed |")
    print("|---|---:|---:|---:|---|")
    for way, found in rows.items():
        shown = " | ".join(f"{value:.3f}" for value in np.mean(found, axis=0))
        print(f"| {way} | {shown} | {', '.join(f'{row[0]:.3f}' for row in found)} |")


def judged(trainer: Trainer, changes: Mapping[str, float]) -> Iterator[tuple[float, float, float]]:
    """Yield overlap, precision and recall of the masks of all pictures on the path."""
    scene, training = trainer.scene, trainer.renderer
    given = training.engine, training.pictures, training.background
    standing = standing_of(ViewRenderer(trainer.result(), *given), key="")
    kept = {name: getattr(second_masks, name) for name in changes}
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name, value in changes.items():
                setattr(second_masks, name, value)
            write_second_masks(Path(folder), scene, standing, lambda done, total: None)
        finally:
            for name, value in kept.items():
                setattr(second_masks, name, value)
        for view, masked in zip(scene.views, with_masks(scene, Path(folder)).views, strict=True):
            if masked is view:  # beside the path
                continue
            true, found = (read_mask(own.signals[MOVING]) for own in (view, masked))
            both = (true & found).sum()
            yield both / (true | found).sum(), both / max(1, found.sum()), both / true.sum()


if __name__ == "__main__":
    main()
