"""A spiral camera path over the directions from which the scene was seen."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gsdmsr_cli.paths._around import Surround, Vector, perpendicular, surround
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.film import PathOptions, Shot, moments, over_time
from gsdmsr_cli.scene.scene import Scene

TAKES = frozenset({"frames", "centre"})
FRAMES = 180
TURNS = 2
NARROW = math.radians(60)
"""Cameras that nine times out of ten stand within this angle of their mean face one side only."""


def shots(scene: Scene, options: PathOptions) -> list[Shot]:
    """Return two turns while time goes from 0 to 1.

    Raises:
        DataError: there are no train views.
    """
    cameras = [view.camera for view in scene.split("train")]
    return over_time(spiral(cameras, np.array(options.centre), options.frames or FRAMES))


def spiral(cameras: Sequence[Camera], centre: Vector, count: int) -> list[Camera]:
    """Return ``count`` cameras at the mean distance of ``cameras``, all facing ``centre``.

    Where the cameras stand all round, the spiral climbs from the height above which nine of ten
    stand to that below which nine of ten do. Where they stand on one side, it opens from their
    mean direction to the angle within which nine of ten stand, and closes again.

    Args:
        cameras: one or more cameras round the scene.
        centre: (3,) the point that the cameras face [world units].
        count: number of cameras.
    """
    around = surround(cameras, centre)
    offsets = np.stack([camera.centre - centre for camera in cameras])
    directions = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    middle = directions.mean(0)
    length = float(np.linalg.norm(middle))
    if length > 1e-6:
        middle = middle / length
        spread = float(np.percentile(np.arccos((directions @ middle).clip(-1, 1)), 90))
        if spread < NARROW:
            return [_opening(around, middle, spread, u) for u in moments(count)]
    low, high = np.percentile(around.elevations, [10, 90])
    turn = 2 * math.pi * TURNS
    return [around.camera(turn * u, low + (high - low) * u) for u in moments(count)]


def _opening(around: Surround, middle: Vector, spread: float, u: float) -> Camera:
    """Return the camera at ``u`` in [0, 1] of a spiral that opens to ``spread`` and closes."""
    right = perpendicular(around.ahead, middle)
    turn, angle = 2 * math.pi * TURNS * u, spread * math.sin(math.pi * u)
    aside = math.cos(turn) * right + math.sin(turn) * np.cross(middle, right)
    return around.camera_in(math.cos(angle) * middle + math.sin(angle) * aside)
