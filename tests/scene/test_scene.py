"""What a scene says of its views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.scene import Scene, View


def scene_of(positions: list[float], bound: float) -> Scene:
    """Return a scene whose cameras stand at these places along x."""
    views = []
    for i, x in enumerate(positions):
        pose = np.eye(4)
        pose[0, 3] = -x
        views.append(View(str(i), Camera(pose, 9.0, 9.0, 4.0, 4.0, 8, 8), 0.0, "train", Path()))
    return Scene(Path(), "test", tuple(views), np.zeros((0, 3), "f4"), None, None, bound, "")


@pytest.mark.parametrize(
    ("positions", "bound", "radius"),
    [
        ([0.0, 2.0, 4.0, 10.0], 1.3, 1.1 * 6),  # their mean is 4
        ([0.0, 0.2], 1.3, 1.3),  # cameras that hardly move look at something of that size
        ([5.0], 2.0, 2.0),
    ],
)
def test_the_radius_is_that_of_the_cameras_or_of_what_they_see(
    positions: list[float], bound: float, radius: float
) -> None:
    assert scene_of(positions, bound).radius == pytest.approx(radius)
