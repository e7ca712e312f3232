"""Sorts points into cells, and those into smaller ones, by halving."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def cells_of(points: NDArray[np.floating], most: Sequence[int]) -> NDArray[np.int32]:
    """Return in which cell of each level points are, (N, L) int32.

    A cell is halved at the median along its longest side until none of a level holds more points
    than it may, so cells follow the density of the points, and each lies within one of the level
    before. Cells are numbered from 0 over all levels, none of them is empty.

    Args:
        points: (N, 3), N above 0.
        most: L numbers of points that a cell of each level has at most, which descend.
    """
    own = np.zeros(len(points), np.int64)
    levels: list[NDArray[np.int64]] = []
    for limit in most:
        while np.bincount(own).max() > limit:
            own = _halved(points, own)
        levels.append(own)
    first, numbered = 0, []
    for level in levels:
        names, index = np.unique(level, return_inverse=True)
        numbered.append(first + index)
        first += len(names)
    return np.stack(numbered, axis=1).astype(np.int32)


def _halved(points: NDArray[np.floating], own: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the halves (N,) that points are in, of cells of consecutive numbers."""
    order = np.argsort(own, kind="stable")
    sizes = np.bincount(own)
    starts = np.cumsum(sizes) - sizes
    sorted_points = points[order]
    sides = np.maximum.reduceat(sorted_points, starts) - np.minimum.reduceat(sorted_points, starts)
    along = np.take_along_axis(points, sides.argmax(axis=1)[own][:, None], axis=1)[:, 0]
    order = np.lexsort((along, own))
    ranks = np.empty(len(points), np.int64)
    ranks[order] = np.arange(len(points)) - starts[own[order]]
    halves: NDArray[np.int64] = 2 * own + (ranks >= (sizes[own] + 1) // 2)
    return np.unique(halves, return_inverse=True)[1]
