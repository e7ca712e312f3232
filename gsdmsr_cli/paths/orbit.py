"""A circular camera path around the scene, at the cameras' mean distance and height."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gsdmsr_cli.paths._around import Vector, surround
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.film import PathOptions, Shot, over_time
from gsdmsr_cli.scene.scene import Scene

TAKES = frozenset({"frames", "centre"})
FRAMES = 120


def shots(scene: Scene, options: PathOptions) -> list[Shot]:
    """Return one turn while time goes from 0 to 1; the last frame stands a step before the first.

    Raises:
        DataError: there are no train views.
    """
    cameras = [view.camera for view in scene.split("train")]
    return over_time(orbit(cameras, np.array(options.centre), options.frames or FRAMES))


def orbit(cameras: Sequence[Camera], centre: Vector, count: int) -> list[Camera]:
    """Return ``count`` cameras once round a circle, all facing ``centre``.

    The circle has the mean distance and elevation of ``cameras`` and begins above the first of
    them; size and focal lengths are the first one's.

    Args:
        cameras: one or more cameras round the scene.
        centre: (3,) the point that the cameras face [world units].
        count: number of cameras; the last stands one step before the first.
    """
    around = surround(cameras, centre)
    elevation = float(around.elevations.mean())
    return [around.camera(2 * math.pi * i / count, elevation) for i in range(count)]
