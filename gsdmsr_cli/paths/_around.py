"""Places cameras around a point, at the distance and height of given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.camera import Camera, look_at

STEEPEST = math.radians(80)
"""Largest elevation of a made camera; straight above there is no up."""

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Surround:
    """How cameras stand round a point.

    Attributes:
        first: the first camera, whose size and focal lengths made cameras have.
        centre: (3,) the point [world units].
        up: (3,) unit vector.
        ahead: (3,) unit vector at a right angle to ``up``: below it stands the first camera.
        distances: (C,) of the cameras from the point [world units].
        elevations: (C,) of the cameras above the point's horizon [rad].
    """

    first: Camera
    centre: Vector
    up: Vector
    ahead: Vector
    distances: Vector
    elevations: Vector

    @property
    def distance(self) -> float:
        """Mean distance of the cameras, more than 0."""
        return max(float(self.distances.mean()), 1e-3)

    def camera(self, azimuth: float, elevation: float) -> Camera:
        """Return a camera at the mean distance, facing the point; azimuth 0 is ``ahead`` [rad]."""
        flat = math.cos(azimuth) * self.ahead + math.sin(azimuth) * np.cross(self.up, self.ahead)
        height = max(-STEEPEST, min(STEEPEST, elevation))
        direction = math.cos(height) * flat + math.sin(height) * self.up
        pose = look_at(self.centre + self.distance * direction, self.centre, self.up)
        middle = self.first.width / 2, self.first.height / 2
        return replace(self.first, world_to_camera=pose, cx=middle[0], cy=middle[1])

    def camera_in(self, direction: Vector) -> Camera:
        """Return a camera at the mean distance in a unit ``direction``, (3,), from the point."""
        left = np.cross(self.up, self.ahead)
        azimuth = math.atan2(float(direction @ left), float(direction @ self.ahead))
        return self.camera(azimuth, float(np.arcsin(np.clip(direction @ self.up, -1, 1))))


def surround(cameras: Sequence[Camera], centre: Vector) -> Surround:
    """Return how one or more ``cameras`` stand round ``centre``, (3,)."""
    up = common_up(cameras)
    offsets = np.stack([camera.centre - centre for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    sines = offsets @ up / np.maximum(distances, 1e-12)
    elevations = np.arcsin(sines.clip(-1, 1))
    return Surround(cameras[0], centre, up, perpendicular(offsets[0], up), distances, elevations)


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


def perpendicular(vector: Vector, axis: Vector) -> Vector:
    """Return the unit vector nearest to ``vector`` at a right angle to the unit vector ``axis``."""
    flat = vector - (vector @ axis) * axis
    if np.linalg.norm(flat) <= 1e-6 * max(float(np.linalg.norm(vector)), 1e-6):
        flat = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    unit: Vector = flat / np.linalg.norm(flat)
    return unit
