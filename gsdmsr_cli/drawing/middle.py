"""Finds the middle of what a model shows: the point that cameras going round it should face."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera

Vector = NDArray[np.float64]

SIDE = 128
"""Longer side of the pictures that are looked at [px]."""

MOST_CUT = 0.1
"""Mean opacity of the outermost pixels, over that of all, above which an object is cut there."""

LEAST_SPREAD = 0.02
"""Least eigenvalue of what rays leave open: they cross at about 16 degrees or more."""


@torch.no_grad()
def middle(model: Model, shots: Sequence[tuple[Camera, float]], engine: Engine) -> Vector | None:
    """Return the point (3,) nearest to the rays through the middles of what pictures show.

    The middle of a picture is the mean of its pixels by opacity, so floaters and splats that
    nobody sees count for little. None where most pictures are filled to their edges, as of a scene
    with walls, or where all cameras look in about the same direction: there is no telling.

    Args:
        model: what is drawn.
        shots: one or more cameras and times in [0, 1].
        engine: what draws.
    """
    behind = model.splats.means.new_zeros(3)
    rays = []
    for camera, time in shots:
        small = _small(camera)
        alpha = draw(model, small, time, engine, behind).alpha
        direction = _through_middle(small, alpha.reshape(small.height, small.width).cpu().numpy())
        if direction is not None:
            rays.append((small.centre, direction))
    return _crossing(rays) if 2 * len(rays) >= len(shots) else None


def _small(camera: Camera) -> Camera:
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    return camera.resized(*(max(1, round(side * scale)) for side in (camera.width, camera.height)))


def _through_middle(camera: Camera, alpha: NDArray[np.float32]) -> Vector | None:
    """Return the unit direction through the middle of what is seen; None if it is cut or nothing.

    Args:
        camera: that has seen it.
        alpha: (H, W) opacities.
    """
    edge = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    total = float(alpha.sum(dtype=np.float64))
    if not total > 0 or float(edge.mean()) > MOST_CUT * total / alpha.size:
        return None
    x = float(alpha.sum(0, dtype=np.float64) @ (np.arange(camera.width) + 0.5)) / total
    y = float(alpha.sum(1, dtype=np.float64) @ (np.arange(camera.height) + 0.5)) / total
    ahead = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
    direction: Vector = camera.rotation.T @ (ahead / np.linalg.norm(ahead))
    return direction


def _crossing(rays: Sequence[tuple[Vector, Vector]]) -> Vector | None:
    """Return the point (3,) with the least squared distances to rays; None if it is undecided.

    Args:
        rays: start [world units] and unit direction of each, (3,).
    """
    aside = [np.eye(3) - np.outer(direction, direction) for _, direction in rays]
    total = np.mean(aside, axis=0)
    if np.linalg.eigvalsh(total)[0] < LEAST_SPREAD:
        return None
    starts = [across @ start for across, (start, _) in zip(aside, rays, strict=True)]
    point: Vector = np.linalg.solve(total, np.mean(starts, axis=0))
    return point
