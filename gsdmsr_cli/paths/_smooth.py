"""Interpolates smoothly between cameras, and keeps what they look at in the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.paths._quaternions import (
    Floats,
    bezier,
    exponential,
    multiply,
    quaternion,
    turns,
)
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.film import Shot

STEP = 1e-3
"""Least length between two keys, so that those at the same place are apart in time."""


@dataclass(frozen=True, eq=False)
class Key:
    """A camera and a moment that the path passes."""

    camera: Camera
    time: float


def interpolate(keys: Sequence[Key], knots: Floats, at: Floats) -> list[Shot]:
    """Return the shots at the places ``at`` of the smooth path through two or more ``keys``.

    Each camera is taken apart into its rotation, the point on its line of sight that is level with
    the world's origin, and the distance to that point. So cameras that look at the scene from
    different sides are joined by a path round it, which keeps it in the picture. Size is the first
    camera's; lenses, relative to the height, and time go straight from neighbour to neighbour.

    Args:
        keys: what is passed through, exactly.
        knots: (K,) where on the path the keys lie, ascending.
        at: (M,) where on the path the shots lie, within the knots.
    """
    cameras = [key.camera for key in keys]
    distances = np.array([[max(float(camera.translation[2]), 0.0)] for camera in cameras])
    centres = np.stack([camera.centre for camera in cameras])
    targets = centres + distances * np.stack([camera.rotation[2] for camera in cameras])
    rotations = turned(knots, np.stack([camera.rotation for camera in cameras]), at)
    far = hermite(knots, distances, at).clip(min=0)
    places = hermite(knots, targets, at) - far * rotations[:, 2]
    rows = [[*_lens(key.camera), key.time] for key in keys]
    between = np.stack([np.interp(at, knots, column) for column in np.array(rows).T], axis=1)
    return [
        Shot(_camera(cameras[0], place, rotation, row[:4]), float(row[4]))
        for place, rotation, row in zip(places, rotations, between, strict=True)
    ]


def lengths(keys: Sequence[Key]) -> Floats:
    """Return the (K - 1,) lengths between neighbours, so that even steps look even.

    The length of the path over the keys' mean distance from the origin, plus the angle turned
    [rad], plus the time that passes.
    """
    centres = np.stack([key.camera.centre for key in keys])
    scale = max(float(np.linalg.norm(centres, axis=1).mean()), 1e-12)
    ways = np.linalg.norm(np.diff(centres, axis=0), axis=1) / scale
    quats = np.stack([quaternion(key.camera.rotation) for key in keys])
    angles = np.linalg.norm(turns(quats), axis=1)
    passed = np.abs(np.diff([key.time for key in keys]))
    return np.asarray(np.maximum(ways + angles + passed, STEP))


def hermite(knots: Floats, values: Floats, at: Floats) -> Floats:
    """Return the (M, D) points at ``at`` of a cubic Hermite spline through ``values``, (K, D)."""
    steps = np.diff(knots)[:, None]
    tangents = _tangents(np.diff(values, axis=0) / steps, steps)
    i, u = _segment(knots, at)
    u, h = u[:, None], steps[i]
    return np.asarray(
        (1 + 2 * u) * (1 - u) ** 2 * values[i]
        + u * (1 - u) ** 2 * h * tangents[i]
        + u**2 * (3 - 2 * u) * values[i + 1]
        - u**2 * (1 - u) * h * tangents[i + 1]
    )


def turned(knots: Floats, rotations: Floats, at: Floats) -> Floats:
    """Return the (M, 3, 3) rotations at ``at`` on a smooth curve through (K, 3, 3) ones.

    The same spline among rotations: Bezier curves of arcs (Shoemake 1985), which between two
    rotations alone are SLERP. Neighbours are joined by the shorter arc.
    """
    quats = np.stack([quaternion(rotation) for rotation in rotations])
    steps = np.diff(knots)[:, None]
    thirds = _tangents(turns(quats) / steps, steps) / 3
    i, u = _segment(knots, at)
    start, end, h = quats[i], quats[i + 1], steps[i]
    leaving = multiply(start, exponential(thirds[i] * h))
    arriving = multiply(end, exponential(-thirds[i + 1] * h))
    quats_between = torch.from_numpy(bezier([start, leaving, arriving, end], u))
    return np.asarray(quat_to_rotmat(quats_between).numpy())


def _tangents(slopes: Floats, steps: Floats) -> Floats:
    """Return the (K, D) derivatives at the knots of a curve with (K - 1, D) mean slopes.

    At inner knots that of the parabola through three neighbours, at the ends that of the parabola
    through the last three; two values are joined by a line.
    """
    if len(slopes) == 1:
        return np.repeat(slopes, 2, axis=0)
    inner = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
    return np.concatenate([2 * slopes[:1] - inner[:1], inner, 2 * slopes[-1:] - inner[-1:]])


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
