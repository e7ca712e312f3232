"""Follows points of surfaces through a stream: how far they end from where they should be.

A ring of 16 cameras films the ray-traced room, of which two things are known at all times. A point
goes with the splat that counts most where it was at the first moment, as in Dynamic 3D Gaussians
(Luiten et al., 3DV 2024, section 4): at its place in the splat's own axes.

python tests/training/measure_tracks.py OUT [--seeds 0 1 2] [--ways hicom ...]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from moving_room import THINGS, Floats, Thing, write_rig
from stream_checks import WAYS, each_moment, psnr_of

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.streaming.trainer import StreamTrainer

SEEING = 2
"""Cameras that see a point at every moment, at least."""

SMALL = "splats.count=15000", "density.cap=25000"


def seen_throughout(
    thing: Thing, cameras: Sequence[Camera], times: Sequence[float], count: int
) -> Floats:
    """Return those of ``count`` points of the unplaced surface that cameras see at all times."""
    points = thing.surface(count, np.random.default_rng(0))
    for time in times:
        placed = thing.at(points, time)
        seeing = np.zeros(len(points), int)
        for camera in cameras:
            rays = placed - camera.centre
            far = np.min([other.meet(camera.centre, rays, time)[0] for other in THINGS.values()], 0)
            local = rays @ camera.rotation.T
            u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
            v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
            inside = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
            seeing += (local[:, 2] > 0) & inside & (far > 1 - 1e-6)
        points = points[seeing >= SEEING]
    return points


def held_by(splats: Splats, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the splat (P,) that counts most at each point, and the place in its axes (P, 3)."""
    turned = quat_to_rotmat(splats.quats)
    opacities, scales = splats.logit_opacities.sigmoid(), splats.log_scales.exp()
    rows = []
    for point in points:
        local = ((point - splats.means)[:, None] @ turned)[:, 0] / scales
        rows.append((opacities * (-0.5 * local.square().sum(dim=1)).exp()).argmax())
    held = torch.stack(rows)
    away = points - splats.means[held]
    return held, (away[:, None] @ turned[held])[:, 0]


def errors(data: Path, way: str, options: Sequence[str], points: dict[str, Floats]) -> list[float]:
    """Return for each thing the median of errors over paths [%], and of errors at the end [m].

    Then the median of errors over paths of all points [%], and the PSNR of the test cameras, the
    mean over all moments [dB].
    """
    preset = load_preset(way, None, [*SMALL, "training.threads=1", *options])
    trainer = StreamTrainer(
        read_scene(data), preset, best_engine("cpu"), Pictures((0.0, 0.0, 0.0), 1, 1 << 28)
    )
    held: dict[str, tuple[torch.Tensor, torch.Tensor]] = {}
    found: dict[str, list[Floats]] = {name: [] for name in points}
    psnr, told = [], []
    for moment in each_moment(trainer):
        psnr.append(psnr_of(trainer))
        with torch.no_grad():
            splats = trainer.model.at(trainer.model.instant(trainer.shot.time)).splats
            for name, own in points.items():
                if not moment:
                    begun = THINGS[name].at(own, trainer.shot.time)
                    held[name] = held_by(splats, torch.from_numpy(begun).float())
                rows, places = held[name]
                turned = quat_to_rotmat(splats.quats[rows])
                now = splats.means[rows] + (turned @ places[:, :, None])[:, :, 0]
                found[name].append(now.double().numpy())
    shares: list[Floats] = []
    for name, own in points.items():
        true = np.array([THINGS[name].at(own, shot.time) for shot in trainer.shots])
        ways = np.linalg.norm(np.diff(true, axis=0), axis=2).sum(0)
        apart = np.linalg.norm(np.array(found[name]) - true, axis=2)
        shares.append(100 * apart.mean(0) / ways)
        told += [float(np.median(shares[-1])), float(np.median(apart[-1]))]
    return [*told, float(np.median(np.concatenate(shares))), fmean(psnr)]


def main() -> None:
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("out", type=Path)
    asked.add_argument("--width", type=int, default=160)
    asked.add_argument("--moments", type=int, default=31)
    asked.add_argument("--points", type=int, default=400)
    asked.add_argument("--steps", type=int, default=2000, help="of the first moment")
    asked.add_argument("--later", type=int, default=60, help="steps of each later one")
    asked.add_argument("--seeds", type=int, nargs="+", default=[0])
    asked.add_argument("--ways", nargs="+", default=WAYS)
    asked.add_argument("--set", dest="options", metavar="KEY=VALUE", action="append", default=[])
    args = asked.parse_args()
    torch.set_num_threads(1)
    data = args.out / f"ring{args.width}x{args.moments}"
    if not (data / "transforms.json").is_file():
        write_rig(data, args.width, args.moments, True)
    views = read_scene(data).split("train")
    times = sorted({view.time for view in views})
    cameras = [view.camera for view in views if view.time == times[0]]
    points = {n: seen_throughout(t, cameras, times, args.points) for n, t in THINGS.items()}
    titles = [f"{name}, {len(own)} points [%] | at the end [m]" for name, own in points.items()]
    print(f"| preset | {' | '.join(titles)} | all points [%] | PSNR |")
    print("|---|" + "---:|" * (2 * len(points) + 2))
    for way in args.ways:
        given = [f"training.steps={args.steps}", f"stream.steps={args.later}", *args.options]
        runs = [errors(data, way, [*given, f"training.seed={s}"], points) for s in args.seeds]
        means = [f"{fmean(column):.3g}" for column in zip(*runs, strict=True)]
        print(
            f"| `{way}` | {' | '.join(means[:-1])} | {fmean(r[-1] for r in runs):.2f} |", flush=True
        )


if __name__ == "__main__":
    main()
