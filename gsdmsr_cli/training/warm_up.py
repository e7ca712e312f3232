"""Runs every kernel of a training once, so that its clock starts on compiled code."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.trainer import Trainer

STEPS = 26
"""Enough to pass through every phase of a schedule whose phases last 4 % or more."""

SPLATS = 64


class _GreyPictures(Pictures):
    """Pictures of views that have no file."""

    def __init__(self) -> None:
        super().__init__((1.0, 1.0, 1.0), 1, 0)

    def decode(self, view: View) -> Tensor:
        return torch.full((3, view.camera.height, view.camera.width), 128, dtype=torch.uint8)


def warm_up(
    scene: Scene, preset: Preset, engine: Engine, device: torch.device | str = "cpu"
) -> float:
    """Train a handful of splats on small grey pictures; return how long it took [s].

    The steps sweep the preset's own phases and grow splats all the way. Torch's global random
    state is left as it was. Without a cache of compiled kernels this takes two minutes or so.
    """
    started = time.perf_counter()
    with torch.random.fork_rng(devices=[]):
        trainer = Trainer(_small(scene), _short(preset), engine, _GreyPictures(), device)
        for _ in range(STEPS):
            trainer.step()
    return time.perf_counter() - started


def warm_up_motion(scene: Scene, preset: Preset, engine: Engine) -> None:
    """Run the kernels of the motion alone, in all its phases.

    A worker begins with it: the training and its workers then compile different kernels at the
    same time, and find the others in the cache.
    """
    with torch.random.fork_rng(devices=[]):
        trainer = Trainer(_small(scene), _short(preset), engine, _GreyPictures())
        model, view = trainer.model, trainer.views[0]
        for step in range(STEPS):
            model.advance(step / STEPS)
            instant = model.instant(0.5, trainer.renderer.camera(view, step / STEPS))
            splats = model.at(instant).splats
            outcome = splats.means.sum() + splats.quats.sum() + splats.log_scales.sum()
            penalty = model.penalty(instant, torch.Generator())
            torch.autograd.backward([outcome] if penalty is None else [outcome, penalty])


def _short(preset: Preset) -> Preset:
    training = replace(preset.training, steps=STEPS, budget=None)
    growing = replace(preset.density, every=5, start=0, until=1.0, gradient=1e-12, cap=4 * SPLATS)
    density = replace(growing, prune_scale=1e9, prune_opacity=0.0)
    splats = replace(preset.splats, count=SPLATS)
    return replace(preset, training=training, density=density, splats=splats)


def _small(scene: Scene) -> Scene:
    """Return a scene of the same times whose pictures are as wide modulo 16, but small.

    The kernels' memory layout depends on whether rows are a multiple of the SIMD width.
    """
    first = scene.split("train")[0].camera
    size = 32 + first.width % 16
    views = []
    for i, moment in enumerate(scene.train_times):
        # two moments for each camera, for terms of the loss that compare these
        angle = 2 * math.pi * (i // 2) / len(scene.train_times)
        centre = 3 * scene.bound * np.array([math.cos(angle), math.sin(angle), 0.5])
        pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        camera = Camera(pose, size, size, size / 2, size / 2, size, size)
        views.append(View(str(i), camera, moment, "train", Path(str(i))))
    points = np.empty((0, 3), np.float32)
    return replace(scene, views=tuple(views), points=points, colours=points)
