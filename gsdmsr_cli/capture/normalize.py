"""Turns a reconstruction upright, centres it and brings it to a common size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.formats import _world
from gsdmsr_cli.scene.scene import View

Floats = NDArray[np.float64]

TEST_PHASE = 0.5
"""Test frames lie in the middle of their intervals: the first and last frames are for training."""


def normalize(
    found: Reconstruction, times: Sequence[float], test_every: int
) -> tuple[tuple[View, ...], Floats, float]:
    """Return the views, the (P, 3) points and the bound of a normalised world.

    Its z axis points where the tops of the pictures point on average; its origin and unit are those
    of every capture (``formats._world``).

    Args:
        found: in COLMAP's world.
        times: of the cameras, in [0, 1].
        test_every: every so many views one is of the split test.
    """
    turn = np.eye(4)
    turn[:3, :3] = upright(found.poses[:, :3, :3])
    views = [
        View(
            name=Path(name).stem,
            camera=found.lens.camera(pose @ turn.T),
            time=time,
            split="test" if is_test(i, test_every) else "train",
            image_path=Path("images") / name,
        )
        for i, (name, pose, time) in enumerate(zip(found.names, found.poses, times, strict=True))
    ]
    points = found.points @ turn[:3, :3].T
    world = _world.normalize(views, points)
    return world.views(views), world.points(points).astype(np.float64), world.bound


def is_test(index: int, every: int) -> bool:
    """Return whether the view is kept for testing; none is if ``every`` is 0."""
    return every > 0 and index % every == int(every * TEST_PHASE)


def upright(rotations: Floats) -> Floats:
    """Return the (3, 3) rotation that takes the mean of the cameras' up to the z axis.

    Args:
        rotations: (N, 3, 3) from world to camera axes, in which up is -y.
    """
    up = -rotations[:, 1].mean(axis=0)
    length = float(np.linalg.norm(up))
    if length < 1e-3:  # the cameras have no common up
        return np.eye(3)
    up = up / length
    # x stays as near to the first camera's right as it can
    right = rotations[0, 0] - up * (rotations[0, 0] @ up)
    if np.linalg.norm(right) < 1e-6:
        right = rotations[0, 2] - up * (rotations[0, 2] @ up)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(up, right), up])
