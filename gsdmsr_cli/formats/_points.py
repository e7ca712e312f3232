"""Reads initial points: positions, and colours in [0, 1] where there are any."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.vertices import read_vertices

Points = tuple[NDArray[np.float64], NDArray[np.float32] | None]
"""(P, 3) positions and (P, 3) colours, or None for the latter."""


def none() -> Points:
    """Return no points."""
    return uncoloured(np.zeros((0, 3)))


def uncoloured(points: NDArray[np.float64]) -> Points:
    """Return the finite ones of (P, 3) points, which have no colours."""
    return points[np.isfinite(points).all(axis=1)], None


def read_ply(path: Path) -> Points:
    """Return the points of a PLY file: x y z, and red green blue where it has them.

    Raises:
        DataError: the file cannot be read or has no positions.
    """
    rows = read_vertices(path)
    names = set(rows.dtype.names or ())
    if missing := sorted({"x", "y", "z"} - names):
        raise DataError(f"{path}: its vertices have no {', '.join(missing)}")
    points = np.stack([rows[axis].astype(np.float64) for axis in "xyz"], axis=1)
    if not {"red", "green", "blue"} <= names:
        return uncoloured(points)
    channels = [_channel(rows[name]) for name in ("red", "green", "blue")]
    colours = np.stack(channels, axis=1)
    finite = np.isfinite(points).all(axis=1) & np.isfinite(colours).all(axis=1)
    return points[finite], colours[finite]


def _channel(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return one channel of colours, (P,); whole numbers count up to 255, others up to 1."""
    full = 1.0 if np.issubdtype(values.dtype, np.floating) else 255.0
    return np.clip(values / np.float32(full), 0, 1).astype(np.float32)
