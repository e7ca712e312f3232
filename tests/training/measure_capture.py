"""What refined cameras and exposures are worth on a synthetic capture, in a table.

PYTHONPATH=tests python tests/training/measure_capture.py [--steps 1500] [--seeds 0 1 2]
"""

from __future__ import annotations

import argparse
import tempfile
from itertools import chain
from pathlib import Path

from measured_captures import camera_error, print_row, scores, trained
from walking_capture import write_capture

DEVICES = {
    "neither": "[]",
    "cameras": "[{name: cameras}]",
    "exposure": "[{name: exposure}]",
    "both": "[{name: cameras}, {name: exposure}]",
    "cameras with focal": "[{name: cameras, focal: true}]",
}
"""Layers by what a row of the table is called."""

CAPTURES = {
    "as it should be": (0.0, 0.0),
    "poses": (1.0, 0.0),
    "colours": (0.0, 0.2),
    "poses and colours": (1.0, 0.2),
    "focal length": (0.0, 0.0, 1.03),
    "poses and focal length": (1.0, 0.0, 1.03),
    "rolling shutter": (0.0, 0.0, 1.0, 1.0),
    "slow rolling shutter": (0.0, 0.0, 1.0, 2.0),
}
"""By what is wrong: error of poses [px], drift of colours, and for some factor on the focal length,
and time in which rows are read as a share of that between two pictures."""

SMALL = "splats.count=2500", "density.cap=12000"


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
                    pixels, drift, *more = CAPTURES[what]
                    given = args.size, args.frames, pixels, drift, seed, *more
                    capture = write_capture(Path(folder), *given)
                    options = [*SMALL, f"layers={DEVICES[name]}", *args.set]
                    trainer = trained(Path(folder), "dnerf", 1.0, args.steps, seed, options)
                    psnr = [scores(trainer, split, "psnr") for split in ("train", "val", "test")]
                    lines.append([camera_error(trainer, capture), *chain.from_iterable(psnr)])
            print_row([what, name], lines)


if __name__ == "__main__":
    main()
