"""Smooth ways through cameras: a spline of their centres, great arcs between their rotations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.film import Shot
from gsdmsr_cli.geometry import quat_to_rotmat

Floats = NDArray[np.float64]

STEP = 1e-3
"""Least length between two keys, so that those at the same place are apart in time."""


@dataclass(frozen=True, eq=False)
class Key:
    """Where the way leads through, and when."""

    camera: Camera
    time: float


def through(keys: Sequence[Key], knots: Floats, at: Floats) -> list[Shot]:
    """Return the shots at the places ``at`` of the way through two or more ``keys``.

    Centres follow a cubic Hermite spline (C1), rotations SLERP, lenses and time go in a straight
    line between neighbours. Size is the first camera's; lenses are taken relative to the height.

    Args:
        keys: what is passed through, exactly.
        knots: (K,) where on the way the keys lie, ascending.
        at: (M,) where on the way the shots lie, within the knots.
    """
    cameras = [key.camera for key in keys]
    centres = hermite(knots, np.stack([camera.centre for camera in cameras]), at)
    rotations = slerp(knots, np.stack([camera.rotation for camera in cameras]), at)
    lenses = np.stack([_lens(camera) for camera in cameras])
    rows = np.column_stack([lenses, [key.time for key in keys]])
    between = [np.interp(at, knots, column) for column in rows.T]
    return [
        Shot(_camera(cameras[0], centre, rotation, row[:4]), float(row[4]))
        for centre, rotation, row in zip(centres, rotations, np.stack(between, 1), strict=True)
    ]


def lengths(keys: Sequence[Key]) -> Floats:
    """Return the (K - 1,) lengths between neighbours, so that even steps look even.

    The length of the way over the keys' mean distance from the origin, plus the angle turned [rad],
    plus the time that passes.
    """
    centres = np.stack([key.camera.centre for key in keys])
    scale = max(float(np.linalg.norm(centres, axis=1).mean()), 1e-12)
    ways = np.linalg.norm(np.diff(centres, axis=0), axis=1) / scale
    quats = np.stack([quaternion(key.camera.rotation) for key in keys])
    cosines = np.abs(np.sum(quats[1:] * quats[:-1], axis=1)).clip(0, 1)
    passed = np.abs(np.diff([key.time for key in keys]))
    return np.asarray(np.maximum(ways + 2 * np.arccos(cosines) + passed, STEP))


def hermite(knots: Floats, values: Floats, at: Floats) -> Floats:
    """Return the (M, D) points at ``at`` of a cubic Hermite spline through ``values``, (K, D).

    Slopes at inner knots are those of the parabola through three neighbours, at the ends those of
    the parabola through the last three; two values are joined by a line.
    """
    steps = np.diff(knots)[:, None]
    slopes = np.diff(values, axis=0) / steps
    if len(values) == 2:
        tangents = np.repeat(slopes, 2, axis=0)
    else:
        inner = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
        tangents = np.concatenate([2 * slopes[:1] - inner[:1], inner, 2 * slopes[-1:] - inner[-1:]])
    i, u = _segment(knots, at)
    u, h = u[:, None], steps[i]
    start, end = values[i], values[i + 1]
    return np.asarray(
        (1 + 2 * u) * (1 - u) ** 2 * start
        + u * (1 - u) ** 2 * h * tangents[i]
        + u**2 * (3 - 2 * u) * end
        - u**2 * (1 - u) * h * tangents[i + 1]
    )


def slerp(knots: Floats, rotations: Floats, at: Floats) -> Floats:
    """Return the (M, 3, 3) rotations at ``at`` on the shortest arcs between (K, 3, 3) ones."""
    quats = np.stack([quaternion(rotation) for rotation in rotations])
    for quat, before in zip(quats[1:], quats, strict=False):
        if quat @ before < 0:  # of the two that mean the same rotation, the nearer one
            quat *= -1
    i, u = _segment(knots, at)
    start, end = quats[i], quats[i + 1]
    angle = np.arccos(np.sum(start * end, axis=1).clip(-1, 1))
    sine = np.sin(angle)
    straight = sine < 1e-9
    safe = np.where(straight, 1.0, sine)
    a = np.where(straight, 1 - u, np.sin((1 - u) * angle) / safe)[:, None]
    b = np.where(straight, u, np.sin(u * angle) / safe)[:, None]
    return np.asarray(quat_to_rotmat(torch.from_numpy(a * start + b * end)).numpy())


def quaternion(rotation: Floats) -> Floats:
    """Return the unit quaternion wxyz of a (3, 3) rotation, w >= 0.

    The eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000), which
    has no special cases and takes the nearest rotation where the matrix is not quite one.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    largest = np.linalg.eigh(k)[1][:, -1]
    return np.asarray(-largest if largest[0] < 0 else largest)


def _segment(knots: Floats, at: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return between which knots the places lie, and how far along there, in [0, 1]."""
    i = np.searchsorted(knots, at, side="right").clip(1, len(knots) - 1) - 1
    return i, ((at - knots[i]) / (knots[i + 1] - knots[i])).clip(0, 1)


def _lens(camera: Camera) -> list[float]:
    """Return focal lengths and the principal point from the middle, over the height."""
    aside, below = camera.cx - camera.width / 2, camera.cy - camera.height / 2
    return [value / camera.height for value in (camera.fx, camera.fy, aside, below)]


def _camera(first: Camera, centre: Floats, rotation: Floats, lens: Floats) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ centre
    fx, fy, aside, below = (lens * first.height).tolist()
    cx, cy = first.width / 2 + aside, first.height / 2 + below
    return Camera(pose, fx, fy, cx, cy, first.width, first.height)
