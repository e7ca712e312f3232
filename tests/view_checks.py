"""Views for tests: cameras that look at the origin, and the pictures that they take over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from datasets import write_picture

from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View

SIZE = 64
UP = np.array([0.0, 0.0, 1.0])


def camera_at(x: float, y: float, z: float = 0.5, focal: float = 70.0) -> Camera:
    pose = look_at(np.array([x, y, z]), np.zeros(3), UP)
    return Camera(pose, focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE)


def views_of(cameras: Sequence[Camera], times: Sequence[float], folder: Path) -> list[View]:
    """Return a view of every camera at every time; all of a time have the same picture file."""
    return [
        View(f"{i}_{j}", camera, time, "train", folder / f"{j}.png")
        for i, camera in enumerate(cameras)
        for j, time in enumerate(times)
    ]


def shifted_pictures(folder: Path, by: int = 3) -> tuple[Pictures, list[View]]:
    """Return two views of one camera; what the second shows lies ``by`` px further right."""
    noise = np.random.default_rng(0).normal(size=(SIZE, SIZE + 8, 3))
    smooth = noise
    for axis in (0, 1):
        smooth = sum(np.roll(smooth, s, axis) for s in (-2, -1, 0, 1, 2))
    texture = np.clip(128 + 12 * smooth, 0, 255).astype(np.uint8)
    for name, left in (("0", by), ("1", 0)):
        write_picture(folder / f"{name}.png", texture[:, left : left + SIZE])
    return Pictures((1.0, 1.0, 1.0), 1, 1 << 20), views_of([camera_at(4, 0)], [0.0, 1.0], folder)
