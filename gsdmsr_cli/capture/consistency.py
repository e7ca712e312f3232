"""Computes which matches contradict the cameras, and which a mere rotation explains."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.colmap import DATABASE
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.capture.verified import shared_pixels
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.native import load_pycolmap

Floats = NDArray[np.float64]

GAPS = (2, 4, 8)
"""Frames so far apart in time are compared."""

OFF = 0.003
"""A match disagrees if it is so far from its epipolar lines (Sampson's distance), as a share of the
picture's longer side; but never nearer than ``LEAST_OFF`` [px]."""

LEAST_OFF = 1.5

NEIGHBOURS = 4
"""A match is compared with so many others that begin near it."""

ALIKE = 0.25
"""They move as it does if their shifts differ by less than this share of it, and ``LEAST_OFF``."""

WIDEST = 5.0
"""No ray is farther than this from the axis, at depth 1: polynomials of lenses explode there."""

FOCALS = np.geomspace(0.35, 2.3, 24)
"""Focal lengths that a turning camera is tried with, in units of the longer side."""

_STEPS = 20


def moving_share(matches: Path, found: Reconstruction) -> float:
    """Return the share of matches, before they were verified, that no standing point explains.

    Only those count that move as their neighbours do; the others are mistakes of the matcher.

    Args:
        matches: folder of the database.
        found: the cameras.
    """
    total = off = 0
    limit = _limit(found.lens)
    with load_pycolmap().Database.open(matches / DATABASE) as database:
        images = {image.name: image.image_id for image in database.read_all_images()}
        ids = [images[name] for name in found.names]
        pixels = [database.read_keypoints(i)[:, :2] for i in ids]
        rays = [rays_of(found.lens, places) for places in pixels]
        for first, second in _pairs(len(ids)):
            if not database.exists_matches(ids[first], ids[second]):
                continue
            pairs = np.asarray(database.read_matches(ids[first], ids[second]), dtype=np.int64)
            essential = essential_matrix(found.poses[first], found.poses[second])
            one, other = rays[first][pairs[:, 0]], rays[second][pairs[:, 1]]
            distances = found.lens.fx * sampson_distance(essential, one, other)
            total += len(pairs)
            shifts = pixels[second][pairs[:, 1]] - pixels[first][pairs[:, 0]]
            off += int(coherent(pixels[first][pairs[:, 0]], shifts, distances > limit).sum())
    return off / max(total, 1)


def turning_share(matches: Path, lens: Lens) -> float:
    """Return the share of verified matches that a camera explains that only turns on its spot.

    Pixels then move by K R K^-1, whatever the depths (Hartley & Zisserman, Multiple View Geometry,
    8.4.2). From such pictures cameras can be made up that fit to a fraction of a pixel; so their
    focal length counts for nothing here, and the one that suits a turn best is taken.

    Args:
        matches: folder of the database.
        lens: its size and principal point.
    """
    pairs = _farthest_matches(matches)
    total = sum(len(one) for one, _ in pairs)
    centre, limit, best = np.array([lens.cx, lens.cy]), _limit(lens), 0
    for focal in max(lens.width, lens.height) * FOCALS:
        explained = 0
        for pixels in pairs:
            one, other = (np.c_[(p - centre) / focal, np.ones(len(p))] for p in pixels)
            turned = one @ _turn(one, other).T
            ahead = turned[:, 2] > 0
            shown = turned[ahead, :2] / turned[ahead, 2:]
            distances = focal * np.linalg.norm(shown - other[ahead, :2], axis=1)
            explained += int((distances < limit).sum())
        best = max(best, explained)
    return best / max(total, 1)


def _limit(lens: Lens) -> float:
    """Return how far a match may lie from where it should [px]."""
    return max(OFF * max(lens.width, lens.height), LEAST_OFF)


def _farthest_matches(matches: Path) -> list[tuple[Floats, Floats]]:
    """Return the (N, 2) pixels that each frame shares with the farthest one it matches."""
    found = []
    with load_pycolmap().Database.open(matches / DATABASE) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        ids = [image.image_id for image in images]
        pixels = {i: database.read_keypoints(i)[:, :2].astype(np.float64) for i in ids}
        for k, first in enumerate(ids):
            for second in reversed(ids[k + 1 :]):
                shared = shared_pixels(database, pixels, first, second)
                if shared is not None:
                    found.append(shared)
                    break
    return found


def _turn(one: Floats, other: Floats) -> Floats:
    """Return the rotation that takes (N, 3) directions to others best (Kabsch 1976)."""
    one, other = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (one, other))
    u, _, vt = np.linalg.svd(other.T @ one)
    return np.asarray(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, dtype=np.float64)


def coherent(
    places: NDArray[np.float32], shifts: NDArray[np.float32], asked: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return for each match that is asked for whether most of its neighbours move as it does.

    Args:
        places: (N, 2) where the matches begin [px].
        shifts: (N, 2) how far they go [px].
        asked: (N,) those asked for.
    """
    if len(places) <= NEIGHBOURS or not asked.any():
        return np.zeros(int(asked.sum()), np.bool_)
    apart = ((places[asked, None] - places[None]) ** 2).sum(axis=2)
    nearest = np.argpartition(apart, NEIGHBOURS, axis=1)[:, : NEIGHBOURS + 1]  # and itself
    differences = np.linalg.norm(shifts[nearest] - shifts[asked, None], axis=2)
    alike = differences < ALIKE * np.linalg.norm(shifts[asked], axis=1)[:, None] + LEAST_OFF
    return np.asarray(alike.sum(axis=1) - 1 > NEIGHBOURS / 2, dtype=np.bool_)


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, i + gap) for gap in GAPS for i in range(count - gap)]


def rays_of(lens: Lens, pixels: NDArray[np.float32]) -> Floats:
    """Return the (N, 2) directions x / z, y / z that the lens shows at (N, 2) pixels."""
    target = pixels.astype(np.float64)
    focal, centre = np.array([lens.fx, lens.fy]), np.array([lens.cx, lens.cy])
    rays: Floats = (target - centre) / focal
    for _ in range(_STEPS):  # a fixed point: lenses bend little
        shown = np.stack(lens.project(rays[:, 0], rays[:, 1]), axis=1)
        rays = np.clip(rays - (shown - target) / focal, -WIDEST, WIDEST)
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
