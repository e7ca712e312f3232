"""What it is worth to leave out what moves of a room that is to stand still, in a table.

PYTHONPATH=tests python tests/training/measure_passers_by.py [--steps 1000] [--seeds 0 1 2]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from measured_captures import print_row, scores, trained
from moving_room import write_capture

OPTIONS = "splats.count=4000", "density.cap=15000"


def main() -> None:
    """Train everything and print a line each."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--steps", type=int, default=1000)
    asked.add_argument("--seeds", type=int, nargs="+", default=[0])
    asked.add_argument("--width", type=int, default=160)
    asked.add_argument("--frames", type=int, default=48)
    asked.add_argument("--inliers", type=float, nargs="+", default=[1.0, 0.9, 0.8, 0.7, 0.6])
    args = asked.parse_args()
    print("| `losses.inliers` | train | val | test, still | val, still, of each seed |")
    print("|---:|---:|---:|---:|---|", flush=True)
    for share in args.inliers:
        lines = []
        for seed in args.seeds:
            with tempfile.TemporaryDirectory() as folder:
                write_capture(Path(folder), args.width, args.frames, 0.0, 0.0, seed)
                given = *OPTIONS, f"losses.inliers={share}"
                trainer = trained(Path(folder), "static-video", 0.0, args.steps, seed, given)
                whole = scores(trainer, "train", "psnr") + scores(trainer, "val", "psnr")
                aside = scores(trainer, "test", "psnr_static")
                lines.append([*whole, *aside, *scores(trainer, "val", "psnr_static")])
        print_row([str(share)], lines)


if __name__ == "__main__":
    main()
