"""Reads from COLMAP's database which pixels of two frames show the same point."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", bound=np.floating[Any])


def shared_pixels(
    database: Any, pixels: dict[int, NDArray[Number]], first: int, second: int
) -> tuple[NDArray[Number], NDArray[Number]] | None:
    """Return what two images share, (N, 2) pixels in each, or None if that is nothing.

    Args:
        database: COLMAP's, open.
        pixels: by each image's number where its features are, (M, 2).
        first, second: numbers of the images.
    """
    if not database.exists_two_view_geometry(first, second):
        return None
    inliers = database.read_two_view_geometry(first, second).inlier_matches
    if not len(inliers):
        return None
    return pixels[first][inliers[:, 0]], pixels[second][inliers[:, 1]]
