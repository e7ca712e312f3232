"""Camera paths: cameras that nobody held, for films of a trained scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.camera import Camera, look_at

STEEPEST = math.radians(80)
"""Largest elevation of an orbit; straight above there is no up."""

Vector = NDArray[np.float64]


def orbit(cameras: Sequence[Camera], centre: Vector, count: int) -> list[Camera]:
    """Return ``count`` cameras once round a circle, all facing ``centre``.

    The circle has the mean distance and elevation of ``cameras`` and begins above the first of
    them; size and focal lengths are the first one's.

    Args:
        cameras: one or more cameras round the scene.
        centre: (3,) what is looked at [world units].
        count: number of cameras; the last stands one step before the first.
    """
    first, up = cameras[0], common_up(cameras)
    offsets = np.stack([camera.centre - centre for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    distance = max(float(distances.mean()), 1e-3)
    sines = offsets @ up / np.maximum(distances, 1e-12)
    elevation = float(np.clip(np.arcsin(sines.clip(-1, 1)).mean(), -STEEPEST, STEEPEST))
    ahead = _perpendicular(offsets[0], up)
    aside = np.cross(up, ahead)
    result = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        flat = math.cos(angle) * ahead + math.sin(angle) * aside
        where = centre + distance * (math.cos(elevation) * flat + math.sin(elevation) * up)
        pose = look_at(where, centre, up)
        result.append(replace(first, world_to_camera=pose, cx=first.width / 2, cy=first.height / 2))
    return result


def common_up(cameras: Sequence[Camera]) -> Vector:
    """Return the (3,) unit vector that is up for all cameras.

    Cameras held level have their x axis at a right angle to it, whichever way they look; where
    that leaves a choice, or the cameras were not held level, the mean of their ups is taken, and z
    if there is none.
    """
    total = -np.sum([camera.rotation[1] for camera in cameras], axis=0)
    length = float(np.linalg.norm(total))
    mean = total / length if length > 1e-6 else np.array([0.0, 0.0, 1.0])
    right = np.stack([camera.rotation[0] for camera in cameras])
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    level = axes[:, 0] * np.sign(axes[:, 0] @ mean)
    return level if spread[0] < 0.01 < 0.1 < spread[1] and level @ mean > 0.7 else mean


def _perpendicular(vector: Vector, axis: Vector) -> Vector:
    """Return the unit vector nearest to ``vector`` at a right angle to the unit vector ``axis``."""
    flat = vector - (vector @ axis) * axis
    if np.linalg.norm(flat) <= 1e-6 * max(float(np.linalg.norm(vector)), 1e-6):
        flat = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    unit: Vector = flat / np.linalg.norm(flat)
    return unit
