"""Makes a small moving scene in D-NeRF's layout by ray tracing textured solids with hard shadows.

It shares nothing with the splatting engines but the camera, so it tells on their mistakes.
"""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.demo.solids import Ball, Box, Capsule, Disc, Floats, Solid, column, dot
from gsdmsr_cli.ground.files import write_text
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.imaging import write_png

CAMERA_ANGLE_X = 0.6911
"""Horizontal field of view [rad], as in the D-NeRF scenes."""

CAMERA_RADIUS = 4.0
"""Distance of every camera from the origin [world units]."""

FLOOR = -0.65
"""Height of the ground [world units]."""

BALL_RADIUS = 0.3
"""Radius of the bouncing ball [world units]."""

_SAMPLES = 3  # per pixel and axis
_AMBIENT, _DIFFUSE = np.float32(0.4), np.float32(0.6)
_TO_LIGHT = column(0.40, -0.25, math.sqrt(1 - 0.40**2 - 0.25**2))  # of unit length
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True, eq=False)
class Placed:
    """A solid in the world at one moment.

    Attributes:
        solid: its shape and texture in its own axes.
        rotation: (3, 3) from its axes to the world's.
        position: (3,) its origin in the world [world units].
    """

    solid: Solid
    rotation: NDArray[np.float64]
    position: NDArray[np.float64]

    def local(self, vectors: Floats) -> Floats:
        """Return (3, R) world directions in the solid's axes."""
        rotated: Floats = self.rotation.T.astype(np.float32) @ vectors
        return rotated

    def distances(self, origins: Floats, directions: Floats) -> Floats:
        """Return where (3, R) rays enter, (R,) [world units]; inf where they miss.

        Either argument may be (3, 1). Only rays that touch the bounding sphere are intersected.
        """
        offsets = origins - column(*self.position)
        along = dot(offsets, directions)
        beside = dot(offsets, offsets) - along * along
        rows = np.flatnonzero(beside < self.solid.radius**2)
        found = np.full(along.shape, np.inf, np.float32)
        origins, directions = (
            self.local(v if v.shape[1] == 1 else v[:, rows]) for v in (offsets, directions)
        )
        found[rows] = self.solid.intersect(origins, directions)
        return found


def solids_at(time: float) -> list[Placed]:
    """Return the scene at ``time`` in [0, 1]; all of it stays within |x|, |y|, |z| <= 1.3."""
    bounce = (2 * time) % 1.0
    height = 4 * 0.75 * bounce * (1 - bounce)
    swing = _rotation("y", 0.6 * math.sin(2 * math.pi * time))
    pivot = np.array([0.0, 0.55, 0.9])
    return [
        Placed(Disc(1.15), np.eye(3), np.array([0.0, 0.0, FLOOR])),
        Placed(Ball(BALL_RADIUS), np.eye(3), ball_centre(height)),
        Placed(
            Box((0.3, 0.22, 0.35)),
            _rotation("z", 0.3 + 2.1 * time),
            np.array([0.55, -0.4, FLOOR + 0.35]),
        ),
        Placed(Capsule(0.3, 0.16), swing, pivot + swing @ np.array([0.0, 0.0, -0.95])),
    ]


def ball_centre(height: float) -> NDArray[np.float64]:
    """Return the (3,) centre of the ball when it is ``height`` above the ground."""
    return np.array([-0.55, -0.35, FLOOR + BALL_RADIUS + height])


def draw(placed: list[Placed], camera: Camera) -> NDArray[np.uint8]:
    """Return the (H, W, 4) picture with straight alpha, anti-aliased by 3 x 3 rays a pixel."""
    directions = _rays(camera)
    centre = column(*camera.centre)
    distances = np.stack([solid.distances(centre, directions) for solid in placed])
    nearest, owner = distances.min(0), distances.argmin(0)
    colours = np.zeros_like(directions)
    for index, solid in enumerate(placed):
        rows = np.flatnonzero((owner == index) & np.isfinite(nearest))
        points = centre + nearest[rows] * directions[:, rows]
        others = [other for other in placed if other is not solid]
        colours[:, rows] = _shade(solid, points, others)
    return _resolve(colours, np.isfinite(nearest), camera)


def _shade(solid: Placed, points: Floats, others: list[Placed]) -> Floats:
    """Return the (3, R) colours of surface points under one distant light.

    The solids are convex, so that none throws a shadow on a side of its own that faces the light.
    """
    local = solid.local(points - column(*solid.position))
    facing = dot(solid.solid.normals(local), solid.local(_TO_LIGHT)).clip(min=0)
    for other in others:
        facing[np.isfinite(other.distances(points, _TO_LIGHT))] = 0
    return solid.solid.colours(local) * (_AMBIENT + _DIFFUSE * facing)


def _rays(camera: Camera) -> Floats:
    """Return the (3, R) unit directions of all rays in world axes, row by row of the fine grid."""
    u = (np.arange(camera.width * _SAMPLES) + 0.5) / _SAMPLES
    v = (np.arange(camera.height * _SAMPLES) + 0.5) / _SAMPLES
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    rays = np.stack([x.ravel(), y.ravel(), np.ones(x.size)]).astype(np.float32)
    rays /= np.linalg.norm(rays, axis=0)
    rotated: Floats = camera.rotation.T.astype(np.float32) @ rays
    return rotated


def _resolve(colours: Floats, hit: NDArray[np.bool_], camera: Camera) -> NDArray[np.uint8]:
    """Average the rays of every pixel: coverage to alpha, colour over those that hit."""
    cells = (camera.height, _SAMPLES, camera.width, _SAMPLES)
    count = hit.reshape(cells).sum((1, 3))
    total = colours.reshape(3, *cells).sum((2, 4))
    rgb = total / np.maximum(count, 1)
    pixels = np.stack([*rgb, count / _SAMPLES**2], axis=-1)
    rounded: NDArray[np.uint8] = np.rint(pixels.clip(0, 1) * 255).astype(np.uint8)
    return rounded


def _rotation(axis: str, angle: float) -> NDArray[np.float64]:
    """Return the (3, 3) rotation about the y or z axis by ``angle`` [rad]."""
    c, s = math.cos(angle), math.sin(angle)
    if axis == "y":
        return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def camera_on_dome(azimuth: float, elevation: float, size: int) -> Camera:
    """Return a square camera of ``size`` pixels that faces the origin; angles in radians."""
    flat = math.cos(elevation)
    centre = CAMERA_RADIUS * np.array(
        [flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)]
    )
    focal = 0.5 * size / math.tan(CAMERA_ANGLE_X / 2)
    pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, focal, focal, size / 2, size / 2, size, size)


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture to draw: its path in the scene's folder without suffix, moment and camera."""

    name: str
    time: float
    camera: Camera


def write_scene(
    folder: Path,
    size: int = 200,
    train: int = 60,
    val: int = 8,
    test: int = 8,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> None:
    """Write the scene into ``folder``: RGBA pictures of ``size`` x ``size`` px and three splits.

    Every split spans the times 0 to 1 evenly. Train and val cameras lie all over the upper half of
    a dome, one a moment; test cameras go round it once. ``progress`` is told (done, total)
    pictures. The transforms are written last: a folder that has them is complete.

    Raises:
        DataError: a picture or the transforms cannot be written.
        OSError: a folder cannot be made.
    """
    generator = np.random.default_rng(seed)
    splits = {
        "train": _shots("train", _scattered(train, size, generator)),
        "val": _shots("val", _scattered(val, size, generator)),
        "test": _shots("test", _circle(test, size)),
    }
    for split in splits:
        (folder / split).mkdir(parents=True, exist_ok=True)
    _draw_all(folder, [shot for shots in splits.values() for shot in shots], progress)
    for split, shots in splits.items():
        write_text(folder / f"transforms_{split}.json", json.dumps(_transforms(shots), indent=1))


def _scattered(count: int, size: int, generator: np.random.Generator) -> list[Camera]:
    """Return cameras spread evenly over the dome, 10 to 75 degrees up, in random order."""
    heights = (generator.permutation(count) + generator.random(count)) / count
    lowest, highest = math.sin(math.radians(10)), math.sin(math.radians(75))
    start = generator.uniform(0, 2 * math.pi)
    return [
        camera_on_dome(
            start + i * _GOLDEN_ANGLE, math.asin(lowest + (highest - lowest) * height), size
        )
        for i, height in enumerate(heights)
    ]


def _circle(count: int, size: int) -> list[Camera]:
    return [camera_on_dome(2 * math.pi * i / count, 0.55, size) for i in range(count)]


def _shots(split: str, cameras: list[Camera]) -> list[Shot]:
    last = max(len(cameras) - 1, 1)
    return [Shot(f"{split}/r_{i:03d}", i / last, camera) for i, camera in enumerate(cameras)]


def _draw_all(folder: Path, shots: list[Shot], progress: OnProgress | None) -> None:
    def work(shot: Shot) -> None:
        write_png(folder / f"{shot.name}.png", draw(solids_at(shot.time), shot.camera))

    # NumPy lets go of the interpreter in its loops, so threads do share the work.
    with ThreadPoolExecutor(cores()) as pool:
        for done, _ in enumerate(pool.map(work, shots), start=1):
            if progress is not None:
                progress(done, len(shots))


def _transforms(shots: list[Shot]) -> dict[str, Any]:
    """Return the JSON document of one split: camera-to-world in OpenGL axes (y up, z backward)."""
    to_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {
            "file_path": f"./{shot.name}",
            "time": shot.time,
            "transform_matrix": (np.linalg.inv(shot.camera.world_to_camera) @ to_opengl).tolist(),
        }
        for shot in shots
    ]
    return {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
