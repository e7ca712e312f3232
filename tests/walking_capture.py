"""A ray-traced capture by a camera that walks: its poses are noisy, its exposure drifts.

The scene is that of the demo. Train and val pictures are taken on the path, with what is wrong with
them; test pictures from beside it, by cameras that are known exactly and in mean colours.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from datasets import write_picture
from numpy.typing import NDArray

from gsdmsr_cli.demo.synthetic import CAMERA_RADIUS, camera_on_dome, draw, solids_at
from gsdmsr_cli.model.layers.cameras import corrected
from gsdmsr_cli.scene.camera import Camera

DIMMED = 0.75
"""Of all colours, so that no exposure saturates any."""

OFF_PATH = math.radians(15)
"""Angle between the path and the test cameras."""


_ON_STAGE = np.random.default_rng(0).uniform(-0.8, 0.8, (60, 3))


@dataclass(frozen=True)
class Capture:
    """What is not known in training.

    Attributes:
        cameras: of the train pictures, as they were.
        given: as the capture says they were.
        exposures: (V, 3) factors on the colours.
        points: (P, 3) places that all cameras see, by which their errors are told.
    """

    cameras: Sequence[Camera]
    given: Sequence[Camera]
    exposures: NDArray[np.float64]
    points: NDArray[np.float64] = field(default_factory=lambda: _ON_STAGE)


def write_capture(
    folder: Path,
    size: int,
    frames: int,
    pixels: float,
    drift: float,
    seed: int,
    focal: float = 1.0,
    readout: float = 0.0,
) -> Capture:
    """Write a capture in D-NeRF's layout.

    Args:
        folder: is made.
        size: of the pictures [px].
        frames: on the path; every fourth one is a val picture.
        pixels: error of the poses, root mean square [px]: half of its square is smooth, the other
            half differs from one frame to the next.
        drift: largest deviation of a colour's factor from 1.
        seed: of the errors and the drift.
        focal: factor by which the focal length that is told of train and val pictures is wrong.
        readout: time from the first to the last row of these pictures, of a rolling shutter, as a
            share of that between two pictures.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0, 1, frames)
    true = [_on_path(time, size) for time in times]
    wrong = pose_errors(true, pixels, times, rng)
    given = [
        replace(corrected(camera, error), fx=focal * camera.fx, fy=focal * camera.fy)
        for camera, error in zip(true, wrong, strict=True)
    ]
    exposures = exposure_drift(times, drift, rng)
    val = np.arange(frames) % 4 == 2
    for split, chosen in (("train", ~val), ("val", val)):
        rows = chosen.nonzero()[0]
        lasts = readout * (times[1] - times[0])
        pictures = [_read_by_rows(times[i], size, lasts, exposures[i]) for i in rows]
        _write(folder, split, [given[i] for i in rows], times[rows], pictures)
    aside = times[::4]
    cameras = [_on_path(time, size, OFF_PATH * (-1) ** i) for i, time in enumerate(aside)]
    shots = zip(cameras, aside, strict=True)
    _write(folder, "test", cameras, aside, [_picture(c, t, np.ones(3)) for c, t in shots])
    train = (~val).nonzero()[0]
    return Capture([true[i] for i in train], [given[i] for i in train], exposures[train])


def pixel_errors(found: Sequence[Camera], capture: Capture) -> NDArray[np.float64]:
    """Return by how much cameras show points of the scene in a wrong place, (V,) rms [px].

    After the world has been moved, turned and scaled, by a little, as fits best: splats would have
    come along.
    """
    points = capture.points
    true = np.stack([_places(camera, points) for camera in capture.cameras])
    start = np.stack([_places(camera, points) for camera in found])
    slopes = []
    for number in range(7):
        moved = _moved(points, number, 1e-5)
        then = np.stack([_places(camera, moved) for camera in found])
        slopes.append((then - start).ravel() / 1e-5)
    matrix, rest = np.stack(slopes, axis=1), (true - start).ravel()
    residual = rest - matrix @ np.linalg.lstsq(matrix, rest, rcond=None)[0]
    squares = np.square(residual.reshape(start.shape)).sum(2).mean(1)
    return np.sqrt(squares)


def opengl_pose(camera: Camera) -> NDArray[np.float64]:
    """Return the camera-to-world matrix (4, 4) of axes x right, y up, z back, as in layouts."""
    pose: NDArray[np.float64] = np.linalg.inv(camera.world_to_camera) @ np.diag([1, -1, -1, 1])
    return pose


def _moved(points: NDArray[np.float64], number: int, by: float) -> NDArray[np.float64]:
    """Return points (P, 3) shifted along (0 to 2), turned about (3 to 5) an axis, or scaled (6)."""
    if number == 6:
        return points * (1 + by)
    axis = by * np.eye(3)[number % 3]
    return points + (axis if number < 3 else np.cross(axis, points))


def _places(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, z = camera.rotation @ points.T + camera.translation[:, None]
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def _on_path(time: float, size: int, aside: float = 0.0) -> Camera:
    azimuth = -0.7 + 1.4 * time + 0.05 * math.sin(9 * time)
    return camera_on_dome(azimuth, 0.5 + 0.06 * math.sin(14 * time) + aside, size)


def pose_errors(
    cameras: Sequence[Camera],
    pixels: float,
    times: NDArray[np.float64],
    rng: np.random.Generator,
    points: NDArray[np.float64] = _ON_STAGE,
    distance: float = CAMERA_RADIUS,
) -> NDArray[np.float64]:
    """Return turns [rad] and shifts [world units] (F, 6) without a mean that displace so far.

    Args:
        cameras, times: of the pictures, in their order.
        pixels: by how much they displace ``points`` (P, 3), root mean square [px].
        rng: of the errors.
        distance: of the points from the cameras, about [world units].
    """
    smooth = sum(
        rng.normal(size=6) * np.sin(2 * math.pi * k * times[:, None] + rng.uniform(0, 6.28, 6))
        for k in (1, 2)
    )
    rough = rng.normal(size=(len(times), 6))
    errors = sum(part / np.sqrt(np.square(part).mean()) for part in (smooth, rough))
    errors -= errors.mean(0)
    errors[:, 3:] *= distance
    unit = 1 / cameras[0].fx
    small = [corrected(c, unit * e) for c, e in zip(cameras, errors, strict=True)]
    found = pixel_errors(small, Capture(cameras, small, np.ones((1, 3)), points))
    return errors * unit * pixels / math.sqrt(np.square(found).mean())


def exposure_drift(
    times: NDArray[np.float64], most: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return smooth factors (F, 3) on the colours, of mean 1, about ``most`` from it at most."""
    phases = rng.uniform(0, 6.28, 4)
    light = 0.7 * np.sin(2 * math.pi * 1.3 * times + phases[0])
    tint = 0.3 * np.sin(2 * math.pi * 0.8 * times[:, None] + phases[1:])
    factors = most * (light[:, None] + tint)
    result: NDArray[np.float64] = 1 + factors - factors.mean(0)
    return result


def _picture(camera: Camera, time: float, exposure: NDArray[np.float64]) -> NDArray[np.uint8]:
    drawn = draw(solids_at(float(time)), camera).astype(np.float64)
    drawn[..., :3] *= DIMMED * exposure
    return np.rint(drawn.clip(0, 255)).astype(np.uint8)


def _read_by_rows(
    time: float, size: int, lasts: float, exposure: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return a picture on the path whose rows are of times ``lasts`` apart in all."""
    if not lasts:
        return _picture(_on_path(time, size), time, exposure)
    moments = time + lasts * (np.arange(size) / (size - 1) - 0.5)
    rows = [_picture(_on_path(t, size), t, exposure)[i] for i, t in enumerate(moments)]
    return np.stack(rows)


def skew(size: int, frames: int, readout: float) -> float:
    """Return by how much places of the scene move while half of the rows are read, rms [px]."""
    times, half = np.linspace(0, 1, frames), readout / (frames - 1) / 2
    now, then = (np.stack([_places(_on_path(t, size), _ON_STAGE) for t in times + by])
                 for by in (0.0, half))  # fmt: skip
    return float(np.sqrt(np.square(then - now).sum(2).mean()))


def _write(
    folder: Path,
    split: str,
    cameras: Sequence[Camera],
    times: NDArray[np.float64],
    pictures: Sequence[NDArray[np.uint8]],
) -> None:
    frames = []
    for i, (camera, time, picture) in enumerate(zip(cameras, times, pictures, strict=True)):
        write_picture(folder / split / f"{i:03d}.png", picture)
        name = f"./{split}/{i:03d}"
        frames.append(
            {"file_path": name, "time": time, "transform_matrix": opengl_pose(camera).tolist()}
        )
    angle = 2 * math.atan(cameras[0].width / 2 / cameras[0].fx)
    document = {"camera_angle_x": angle, "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(document), encoding="utf-8")
