"""When two cameras count as one that has hardly moved: by direction and by place."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

MOST_TURN = math.radians(5)
"""Neighbouring views look in directions that differ by this at most [rad]."""

MOST_WAY = 0.1
"""And are taken from places this far apart at most, in units of how far any are from their mean."""


def extent(centres: NDArray[np.float64]) -> float:
    """Return how far any of the places (V, 3) is from their mean; 0 where there is none."""
    if not len(centres):
        return 0.0
    return float(np.linalg.norm(centres - centres.mean(0), axis=1).max())


def centres_of(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where cameras with these poses (V, 4, 4), world to camera, are in the world (V, 3)."""
    found: NDArray[np.float64] = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])
    return found


def ways_and_turns(
    pose: NDArray[np.float64], poses: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far poses (V, 4, 4) are from one (4, 4), (V,) [world units] and (V,) [rad]."""
    ways = np.linalg.norm(centres_of(poses) - centres_of(pose[None]), axis=1)
    # of R = A B^T the trace is 1 + 2 cos, and |A - B|^2 = 6 - 2 trace, which is exact near 0
    squares = np.square(poses[:, :3, :3] - pose[:3, :3]).sum((1, 2))
    return ways, 2 * np.arcsin(np.sqrt(squares / 8).clip(max=1))
