"""Measures where the splats of a rig had better start: on a panel, and on a ring of cameras.

Both film the ray-traced room in which two things move; nothing was trained on the cameras of the
test split. The table has the PSNR of the train cameras, SSIM and PSNR of those of the test split,
means over the seeds, and the last of each seed.

python tests/training/measure_rigs.py OUT --steps 600 --seeds 0 1 2
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from measured_captures import print_row, scores, trained
from moving_room import write_rig

CAMERAS = "panel", "ring"
STARTS = "surfaces", "box", "silhouettes"


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("out", type=Path)
    asked.add_argument("--cameras", choices=CAMERAS, nargs="+", default=CAMERAS)
    asked.add_argument("--preset", default="n3v")
    asked.add_argument("--steps", type=int, default=600)
    asked.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    asked.add_argument("--starts", choices=STARTS, nargs="+", default=STARTS)
    asked.add_argument("--set", dest="options", metavar="KEY=VALUE", action="append", default=[])
    args = asked.parse_args()
    print("| cameras | `splats.start` | train PSNR | test SSIM | test PSNR (each seed) |")
    print("|---|---|---:|---:|---:|")
    for name in args.cameras:
        data = args.out / name
        if not (data / "transforms.json").is_file():
            write_rig(data, 160, 10, name == "ring")
        for start in args.starts:
            options = [f"splats.start={start}", "splats.start_around=null", *args.options]
            lines = []
            for seed in args.seeds:
                trainer = trained(data, args.preset, 0.0, args.steps, seed, options)
                test = scores(trainer, "test", "ssim", "psnr")
                lines.append([*scores(trainer, "train", "psnr"), *test])
            print_row([name, f"`{start}`"], lines)


if __name__ == "__main__":
    main()
