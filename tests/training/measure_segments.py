"""Measures trainings in segments on the demo's scene under a rig: time, memory, quality and seams.

A capture of 100 moments is trained whole, and one that is four times as long in four segments of
the same length each, with what stands still and without, and whole for as many steps. The table has
the time and the memory, the PSNR of a camera that nothing was trained on, and how far consecutive
drawn pictures differ, over how far true ones do, where segments overlap and elsewhere.

python tests/training/measure_segments.py OUT --steps 1500
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

import itertools

from rigs import write_rig

from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.evaluation.metrics import psnr, quantize
from gsdmsr_cli.model.joined import Joined
from gsdmsr_cli.runs.run import is_run, open_run
from gsdmsr_cli.scene.segments import weights

MOMENTS, SPAN, TIMES = 100, 2.0, 4
"""Of the shorter capture, the demo's time at its end, and how much longer the other one is."""


def trained(data: Path, out: Path, *words: object) -> Path:
    """Train a run if it is not there; the preset is that of one object on white."""
    if not is_run(out) or not open_run(out).training_path.is_file():
        line = ["train", "--data", data, "--out", out, "--preset", "dnerf", "--threads", 1, *words]
        command = [sys.executable, "-m", "gsdmsr_cli", *map(str, line), "--overwrite"]
        subprocess.run(command, check=True, stderr=subprocess.DEVNULL)
    return out


def row(name: str, out: Path) -> str:
    """Return what is told of a run."""
    account = json.loads(open_run(out).training_path.read_text())
    with open_trained(out, None) as opened, torch.no_grad():
        renderer = opened.renderer
        views = sorted(opened.scene.split("test"), key=lambda view: view.time)
        drawn = [renderer.draw(view).clamp(0, 1) for view in views]
        true = [renderer.true(view) for view in views]
        scores = [psnr(quantize(a), b) for a, b in zip(drawn, true, strict=True)]
        shared = [
            isinstance(renderer.model, Joined)
            and len(weights(view.time, renderer.model.segments)) == 2
            for view in views
        ]
    ratios = _changes(drawn) / _changes(true)
    at_seams = np.array([a or b for a, b in itertools.pairwise(shared)])
    told = [name, f"{account['train_s']:.0f}", f"{account['peak_rss_mib']:.0f}"]
    told += [f"{account['splats']:,}", f"{fmean(scores):.2f}"]
    if at_seams.any():
        seam, other = float(ratios[at_seams].mean()), float(ratios[~at_seams].mean())
        told += [f"{fmean(s for s, two in zip(scores, shared, strict=True) if two):.2f}"]
        told += [f"{seam:.3f}", f"{other:.3f}", f"{seam / other:.3f}"]
    else:
        told += ["", "", f"{float(ratios.mean()):.3f}", ""]
    return f"| {' | '.join(told)} |"


def _changes(pictures: Sequence[torch.Tensor]) -> np.ndarray:
    """Return the mean difference of each picture from the next."""
    pairs = itertools.pairwise(pictures)
    return np.array([float((a - b).abs().mean()) for a, b in pairs])


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("out", type=Path)
    asked.add_argument("--steps", type=int, default=1500)
    args = asked.parse_args()
    out, steps = args.out, args.steps
    short, long = out / "short", out / "long"
    for data, times in ((short, 1), (long, TIMES)):
        if not (data / "transforms_test.json").is_file():
            write_rig(data, 64, 8, times * MOMENTS, times * SPAN)
    cut = "--segments", TIMES, "--steps", steps
    runs = {
        f"{MOMENTS} moments, whole": trained(short, out / "whole", "--steps", steps),
        f"{TIMES * MOMENTS} moments, {TIMES} segments": trained(long, out / "cut", *cut),
        f"{TIMES * MOMENTS} moments, {TIMES} segments, `segments.static_share=0`": trained(
            long, out / "anew", *cut, "--set=segments.static_share=0"
        ),
        f"{TIMES * MOMENTS} moments, whole, {TIMES} times the steps": trained(
            long, out / "longer", "--steps", TIMES * steps
        ),
    }
    print(
        "| | trained s | MiB | splats | PSNR | PSNR in overlaps | change in overlaps | elsewhere "
        "| ratio |"
    )
    print("|---|" + "---:|" * 8)
    for name, folder in runs.items():
        print(row(name, folder))


if __name__ == "__main__":
    main()
