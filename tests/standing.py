"""Scenes of cameras that stand somewhere, without pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.scene import Scene, View


def rig(cameras: Sequence[Camera], moments: int = 3) -> Scene:
    """A scene that all cameras see at all moments, and another camera, behind them all, in val."""
    times = [moment / 2 for moment in range(moments)]
    views = [
        View(f"{i}", camera, time, "train", Path())
        for time in times
        for i, camera in enumerate(cameras)
    ]
    views.append(View("v", facing(1.0, 0.0, turned=math.pi), 0.0, "val", Path()))
    points = np.zeros((0, 3), np.float32)
    return Scene(Path(), "test", tuple(views), points, None, None, 1.5, "")


def facing(x: float, z: float, turned: float = 0.0) -> Camera:
    """A camera of a panel, which looks along y, or turned about the vertical axis [rad]."""
    centre = np.array([x, -3.0, z])
    ahead = centre + np.array([math.sin(turned), math.cos(turned), 0.0])
    return Camera(look_at(centre, ahead, np.array([0.0, 0.0, 1.0])), 90.0, 90.0, 48, 40, 96, 80)


PANEL = [facing(x, z) for x in (-1.0, 0.0, 1.0) for z in (-0.5, 0.5)]
