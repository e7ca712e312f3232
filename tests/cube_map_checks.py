"""What both forms of colours on a cube are tested with."""

from __future__ import annotations

import numpy as np
import torch
from kernel_checks import assert_near, generator, leaves
from torch import Tensor

from gsdmsr_cli.model.layers.sky import grid_points
from gsdmsr_cli.ops.cube_map import show_behind, show_behind_twin
from gsdmsr_cli.scene.camera import Camera, look_at

SIZES = 2, 5, 40
"""Points along the edges of cubes: the last has more of them than the picture has pixels."""


def wide(width: int, height: int) -> Camera:
    """Return a camera that sees five of six faces."""
    pose = look_at(np.array([3.0, 1.0, 0.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 0.2 * width, 0.2 * height, 0.4 * width, 0.5 * height, width, height)


def values(size: int, width: int, height: int) -> tuple[list[Tensor], Tensor]:
    """Return a picture, its alpha and colours, and the points of the faces."""
    points, rng = grid_points(size), generator(size)
    shapes = (height, width, 3), (height, width), (int(points.max()) + 1, 3)
    return [torch.rand(shape, generator=rng) for shape in shapes], points


def compare(size: int, width: int, height: int, place: str = "cpu") -> None:
    """Hold what serves tensors at a place to the twin in float64, with gradients."""
    start, points = values(size, width, height)
    camera = wide(width, height)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = show_behind(*(t.to(place) for t in ours), points.to(place), camera).cpu()
    truth = show_behind_twin(*exact, points, camera)
    assert_near(found, truth, 1e-5, "picture")
    slope = torch.randn(found.shape, generator=generator(1))
    slope[::3] = 0
    found.backward(slope)
    truth.backward(slope.double())
    for name, a, b in zip(("picture", "alpha", "colours"), ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-4, f"gradient of the {name}")
