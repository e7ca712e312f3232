"""What several stages read of COLMAP's model in the same way."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def point_rows(model: Any) -> dict[int, int]:
    """Return the row of each point by its identifier, in the order of these."""
    return {identifier: row for row, identifier in enumerate(sorted(model.points3D))}


def point_places(model: Any) -> NDArray[np.float64]:
    """Return the points' positions (P, 3), in the order of ``point_rows``."""
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)]).reshape(-1, 3)


def pose_of(cam_from_world: Any) -> NDArray[np.float64]:
    """Return COLMAP's rigid transform as a matrix (4, 4), world to camera."""
    pose = np.eye(4)
    pose[:3] = cam_from_world.matrix()
    return pose
