"""Whether a motion can do what it says: splats on a known trajectory are found from pictures.

A few splats of different colours go where a case says. The pictures of a few cameras are drawn by
the reference engine, without noise, and a real training learns the motion from them. What it has
found is compared with the truth at the moments of the pictures and half way between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from datasets import write_picture
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.raster import best_engine, load_engine
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.trainer import Trainer

COUNT, CAMERAS, FRAMES, SIZE = 6, 3, 13, 48
"""Splats, cameras, moments, and the sides of the pictures [px]."""

SPREAD = 0.14
"""Standard deviation of each splat [world units]; what it goes is at most a few times as far."""

HELD = 1e-20
"""A learning rate that changes nothing, for what a case does not let the training learn."""

WHITE = (1.0, 1.0, 1.0)

OPTIONS = (
    "events=[]", "splats.sh_degree=0", "training.static_until=0", "training.static_steps=0",
    "training.views_per_step=2", "training.low_resolution_until=0", "training.average_from=0.9",
    "losses.ssim=0", "saliency.still_from=1.0", "optimizer.planes=[0.05,1e-4]",
    "optimizer.network=[0.01,1e-5]",
    *(f"optimizer.{name}=[{HELD},{HELD}]" for name in ("means", "log_scales", "quats", "sh")),
    f"optimizer.logit_opacities=[{HELD},{HELD}]",
)  # fmt: skip
"""The splats are known and keep their values; what learns is the motion, from L1 alone."""

Truth = Callable[[Splats, float], Moment]
"""What is really seen of the canonical splats at a time in [0, 1]."""


@dataclass(frozen=True)
class Case:
    """A motion, and the trajectory that it is to find.

    Attributes:
        motion: name and options.
        truth: the trajectory; splats fill a cube of half edge 0.5, and may go 0.4 beyond it.
        layers: further layers, each a name and options.
        options: of the preset, after ``OPTIONS``: rates that are not those of the motion's own.
        steps: length of the training.
        lives: of each splat when it is born and when it dies, (COUNT, 2) in [0, 1], if the truth
            has such: opacities are then compared, and positions only in between.
        between: whether the moments half way between those of the pictures count as well.
    """

    motion: Mapping[str, Any]
    truth: Truth
    layers: Sequence[Mapping[str, Any]] = ()
    options: Sequence[str] = ()
    steps: int = 600
    lives: Tensor | None = None
    between: bool = True

    @property
    def times(self) -> list[float]:
        """The moments at which positions are compared."""
        parts = (2 if self.between else 1) * (FRAMES - 1)
        return [part / parts for part in range(parts + 1)]

    def preset(self) -> Preset:
        """Return the preset of the training."""
        preset = load_preset("static", None, [*OPTIONS, *self.options])
        training = replace(preset.training, steps=self.steps)
        parts = {"motion": dict(self.motion), "layers": tuple(map(dict, self.layers))}
        return replace(preset, training=training, **parts)


def canonical_splats() -> Splats:
    """Return round splats of different colours at the corners of a twisted octahedron."""
    ends = 0.5 * torch.cat([torch.eye(3), -torch.eye(3)])
    turned = ends + 0.12 * ends.roll(1, dims=1) - 0.2 * ends.roll(1, dims=0)
    colours = torch.cat([0.1 + 0.7 * torch.eye(3), 0.8 - 0.7 * torch.eye(3)])
    return Splats(
        means=turned,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(COUNT, 1),
        log_scales=torch.full((COUNT, 3), SPREAD).log(),
        logit_opacities=torch.full((COUNT,), 3.0),
        sh=((colours - 0.5) / SH_C0)[:, None, :],
    )


def moved(path: Callable[[Tensor, float], Tensor]) -> Truth:
    """Return the truth that splats go where ``path(means, time)`` (N, 3) says."""

    def truth(splats: Splats, time: float) -> Moment:
        return Moment(replace(splats, means=path(splats.means, time)))

    return truth


def _cameras() -> list[Camera]:
    """Return cameras on a circle of radius 4, at different heights, that look at the origin."""
    found = []
    for i in range(CAMERAS):
        turn = 2 * np.pi * i / CAMERAS
        centre = np.array([4 * np.cos(turn), 4 * np.sin(turn), 1.5 * (-1) ** i])
        pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        found.append(Camera(pose, 1.6 * SIZE, 1.6 * SIZE, SIZE / 2, SIZE / 2, SIZE, SIZE))
    return found


def scene_of(case: Case, folder: Path) -> Scene:
    """Draw the pictures of the truth and return the scene; its points are the canonical means."""
    splats, engine, views = canonical_splats(), load_engine("reference"), []
    for i, camera in enumerate(_cameras()):
        for frame in range(FRAMES):
            time, path = frame / (FRAMES - 1), folder / f"{i}_{frame:02d}.png"
            drawn = engine.rasterize(case.truth(splats, time), camera, torch.tensor(WHITE)).rgb
            write_picture(path, (255 * drawn.clamp(0, 1)).round().byte().numpy())
            views.append(View(path.stem, camera, time, "train", path))
    points = splats.means.numpy()
    return Scene(folder, "made", tuple(views), points, None, None, 1.0, "none")


@contextmanager
def _one_thread() -> Iterator[None]:
    """Let torch compute on one thread, as ``gsdmsr train`` does."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@_one_thread()
def train(case: Case, folder: Path) -> Model:
    """Let the motion learn from the pictures; return what the training has led to."""
    preset, pictures = case.preset(), Pictures(WHITE, 1, 1 << 24)
    trainer = Trainer(scene_of(case, folder), preset, best_engine("cpu"), pictures)
    with torch.no_grad():
        for name, tensor in canonical_splats().tensors().items():
            trainer.model.splats.tensors()[name].copy_(tensor)
    for _ in range(case.steps):
        trainer.step()
    return trainer.result()


@torch.no_grad()
def position_errors(case: Case, model: Model) -> Tensor:
    """Return the mean distance from the truth of each splat, (COUNT,) in units of its path."""
    splats = canonical_splats()
    found = torch.stack([model.at(model.instant(time)).splats.means for time in case.times])
    true = torch.stack([case.truth(splats, time).splats.means for time in case.times])
    ways = (true[1:] - true[:-1]).norm(dim=2).sum(dim=0)
    apart = (found - true).norm(dim=2)
    if case.lives is None:
        return apart.mean(dim=0) / ways
    times = torch.tensor(case.times)[:, None]
    alive = (times >= case.lives[:, 0]) & (times <= case.lives[:, 1])
    return (apart * alive).sum(dim=0) / alive.sum(dim=0) / ways


@torch.no_grad()
def lives_of(model: Model) -> Tensor:
    """Return when each splat becomes half as opaque as it gets, and when it ceases, (COUNT, 2)."""
    times = torch.linspace(0, 1, 40 * (FRAMES - 1) + 1)
    instants = [model.instant(float(time)) for time in times]
    logits = torch.stack([model.at(one).splats.logit_opacities for one in instants])
    opacities = logits.sigmoid()
    lives = opacities >= opacities.amax(dim=0) / 2
    spans = [times[own][[0, -1]] for own in lives.unbind(1)]
    return torch.stack(spans)


def assert_recovers(case: Case, folder: Path) -> None:
    """Hold positions to 1 % of the paths, and births and deaths to one frame.

    A splat that is seen at the first or the last moment may have been there before, or stay.
    """
    model = train(case, folder)
    errors = position_errors(case, model)
    assert (errors < 0.01).all(), errors
    if case.lives is not None:
        apart = (lives_of(model) - case.lives).abs()
        assert (apart <= 1 / (FRAMES - 1)).all(), apart
