"""Prints what newcomers are worth in a stream into which a ball comes at the third of six moments.

python tests/training/measure_visitor.py OUT [--seeds 0 1 2] [--ways hicom ...]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from rigs import write_rig
from stream_checks import WAYS, each_moment, psnr_of

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.streaming.trainer import StreamTrainer

MOMENTS, COMES = 6, 2

OPTIONS = (
    "data.background=white", "training.steps=400", "training.low_resolution_until=0",
    "training.threads=1", "stream.steps=60", "splats.count=1000", "splats.start=box",
    "density.cap=2000",
)  # fmt: skip


def psnrs(data: Path, way: str, options: list[str]) -> list[float]:
    """Return the PSNR of the camera that is not trained on, at the end of each moment [dB]."""
    preset = load_preset(way, None, [*OPTIONS, *options])
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 28)
    trainer = StreamTrainer(read_scene(data), preset, best_engine("cpu"), pictures)
    return [psnr_of(trainer) for _ in each_moment(trainer)]


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("out", type=Path)
    asked.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    asked.add_argument("--ways", nargs="+", default=WAYS)
    asked.add_argument("--counts", type=int, nargs="+", default=[0, 400])
    args = asked.parse_args()
    data = args.out / "visitor"
    if not (data / "transforms_test.json").is_file():
        write_rig(data, size=64, cameras=10, moments=MOMENTS, span=0.1, visitor=COMES)
    print("| preset | newcomers | " + " | ".join(str(i + 1) for i in range(MOMENTS)) + " |")
    print("|---|---:|" + "---:|" * MOMENTS)
    for way in args.ways:
        for count in args.counts:
            further = f", {{name: newcomers, count: {count}}}" if count else ""
            layers = f"layers=[{{name: exposure}}{further}]"
            runs = [psnrs(data, way, [layers, f"training.seed={seed}"]) for seed in args.seeds]
            means = [sum(values) / len(values) for values in zip(*runs, strict=True)]
            print(
                f"| `{way}` | {count} | " + " | ".join(f"{v:.2f}" for v in means) + " |", flush=True
            )


if __name__ == "__main__":
    main()
