"""Which share of what was matched agrees with the cameras: the rest moves, or is a mistake."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.colmap import DATABASE
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.lens import Lens
from gsdmsr_cli.native import load_pycolmap

Floats = NDArray[np.float64]

GAPS = (2, 4, 8)
"""Frames so far apart in time are compared."""

OFF = 3.0
"""A match disagrees if it is so far from its epipolar lines (Sampson's distance) [px]."""

_STEPS = 20


def disagreeing_share(matches: Path, found: Reconstruction) -> float:
    """Return the share of matches, before they were verified, that no standing point explains.

    Args:
        matches: folder of the database.
        found: the cameras.
    """
    total = off = 0
    with load_pycolmap().Database.open(matches / DATABASE) as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
        ids = [images[name] for name in found.names]
        rays = [rays_of(found.lens, database.read_keypoints(i)[:, :2]) for i in ids]
        for first, second in _pairs(len(ids)):
            if not database.exists_matches(ids[first], ids[second]):
                continue
            pairs = np.asarray(database.read_matches(ids[first], ids[second]), dtype=np.int64)
            essential = essential_matrix(found.poses[first], found.poses[second])
            one, other = rays[first][pairs[:, 0]], rays[second][pairs[:, 1]]
            distances = found.lens.fx * sampson_distance(essential, one, other)
            total += len(pairs)
            off += int((distances > OFF).sum())
    return off / max(total, 1)


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, i + gap) for gap in GAPS for i in range(count - gap)]


def rays_of(lens: Lens, pixels: NDArray[np.float32]) -> Floats:
    """Return the (N, 2) directions x / z, y / z that the lens shows at (N, 2) pixels."""
    target = pixels.astype(np.float64)
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    rays: Floats = (target - centre) / focal
    for _ in range(_STEPS):  # a fixed point: lenses bend little
        shown = np.stack(lens.project(rays[:, 0], rays[:, 1]), axis=1)
        rays = rays - (shown - target) / focal
    return rays


def essential_matrix(first: Floats, second: Floats) -> Floats:
    """Return E with x2' E x1 = 0 for standing points, from two (4, 4) world-to-camera poses."""
    relative = second @ np.linalg.inv(first)
    x, y, z = relative[:3, 3]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(across @ relative[:3, :3], dtype=np.float64)


def sampson_distance(essential: Floats, one: Floats, other: Floats) -> Floats:
    """Return the first-order distance of matches to the epipolar constraint, (N,).

    Hartley & Zisserman, Multiple View Geometry, 11.4.3. In units of the (N, 2) directions.
    """
    ones = np.ones((len(one), 1))
    x1, x2 = np.hstack([one, ones]), np.hstack([other, ones])
    lines2, lines1 = x1 @ essential.T, x2 @ essential
    residual = np.abs(np.sum(x2 * lines2, axis=1))
    slope = np.sqrt(lines1[:, 0] ** 2 + lines1[:, 1] ** 2 + lines2[:, 0] ** 2 + lines2[:, 1] ** 2)
    return np.asarray(residual / np.maximum(slope, 1e-12), dtype=np.float64)
