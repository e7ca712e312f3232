"""Scenes of balls whose pictures are known in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View

BOUND = 1.3
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)

Ball = tuple[tuple[float, float, float], float, tuple[int, int, int]]  # centre, radius, 8-bit RGB

ORANGE: Ball = ((0.3, -0.2, 0.1), 0.7, (230, 120, 20))


def cameras(count: int, size: int, distance: float = 4.0) -> list[Camera]:
    """Return cameras on a spiral round the origin, from below to above, facing it."""
    found = []
    for i in range(count):
        z = -0.9 + 1.8 * i / max(count - 1, 1)
        flat, angle = (1 - z * z) ** 0.5, 2.4 * i
        centre = distance * np.array([flat * np.cos(angle), flat * np.sin(angle), z])
        pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        found.append(Camera(pose, 1.3 * size, 1.3 * size, size / 2, size / 2, size, size))
    return found


def photograph(camera: Camera, balls: list[Ball], background: tuple[float, ...]) -> Tensor:
    """Return the (3, H, W) picture of balls without shading, a pixel by the ray of its centre."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    picture = np.tile(np.array(background) * 255, (*rays.shape[:2], 1))
    nearest = np.full(rays.shape[:2], np.inf)
    for centre, radius, colour in balls:
        offset = camera.rotation @ np.array(centre) + camera.translation
        along = rays @ offset
        beside = offset @ offset - along**2
        hit = (beside < radius**2) & (along > 0) & (along < nearest)
        picture[hit], nearest[hit] = colour, along[hit]
    return torch.from_numpy(picture.round().astype(np.uint8)).permute(2, 0, 1).contiguous()


class Album(Pictures):
    """Pictures that are given, by the view's name."""

    def __init__(self, pictures: list[Tensor]) -> None:
        super().__init__(WHITE, 1, 0)
        self.pictures = pictures

    def load(self, view: View) -> Tensor:
        return self.pictures[int(view.name)]


def scene_of(shots: list[Camera]) -> Scene:
    views = tuple(View(str(i), shot, 0.5, "train", Path(str(i))) for i, shot in enumerate(shots))
    nothing = np.zeros((0, 3), np.float32)
    return Scene(Path(), "test", views, nothing, nothing, None, BOUND, "")
