"""A capture of a room in which two things move, ray-traced under a camera that walks.

A patterned box goes across the room and turns, farther than it is long; a balloon swings and
changes its shape. Where each point of their surfaces is at each time is known. Poses are noisy,
exposures drift, and pictures are blurred by what moves while the shutter is open; test pictures are
sharp, of cameras above and below the path that are known exactly, in mean colours.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from datasets import write_picture
from numpy.typing import NDArray
from room import FOCAL, SIZE, WALLS, look_at, on_cube, out_of_room, pattern
from walking_capture import DIMMED, OFF_PATH, Capture, exposure_drift, opengl_pose, pose_errors

from gsdmsr_cli.model.layers.cameras import corrected
from gsdmsr_cli.scene.camera import Camera

Floats = NDArray[np.float64]

SHUTTER = 0.1
"""Share of the time from one picture to the next for which the shutter is open."""

TARGET = np.array([0.0, 1.4, -0.1])
"""About what the cameras beside the path are turned [m]."""

SEEN = np.random.default_rng(0).uniform([-1.5, 0.3, -1.0], [1.5, 2.2, 1.0], (60, 3))
"""Places that all cameras see, by which their errors are told [m]."""


@dataclass(frozen=True)
class Thing:
    """A box or a balloon about the origin, its half edges or semi-axes 1 before it is placed.

    Attributes:
        round: whether it is a balloon.
        textures: one for each side.
    """

    round: bool
    textures: Sequence[Floats]

    def placed(self, time: float) -> tuple[Floats, Floats]:
        """Return the matrix (3, 3) and the centre (3,) that take it to where it is at a time."""
        since, turn = time - 0.5, 2 * math.pi * time
        if self.round:
            axes = [0.3 + 0.08 * math.sin(turn), 0.3 - 0.08 * math.sin(turn), 0.4]
            centre = [0.2 + 0.4 * math.sin(turn), 1.7, 0.45 + 0.2 * math.cos(turn)]
            return np.diag(axes), np.array(centre)
        c, s = math.cos(1.2 * since), math.sin(1.2 * since)
        turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([0.35, 0.25, 0.3])
        return turned, np.array([2.0 * since, 1.0 + 1.2 * since**2, -0.6])

    def at(self, points: Floats, time: float) -> Floats:
        """Return where points (P, 3) of the unplaced surface are at a time."""
        matrix, centre = self.placed(time)
        return points @ matrix.T + centre

    def meet(self, origin: Floats, rays: Floats, time: float) -> tuple[Floats, Floats]:
        """Return how far along rays (R, 3) the surface is, inf where missed, and its points there.

        The points (R, 3) are those of the unplaced surface.
        """
        matrix, centre = self.placed(time)
        inverse = np.linalg.inv(matrix)
        start, ways = inverse @ (origin - centre), rays @ inverse.T
        with np.errstate(divide="ignore", invalid="ignore"):
            far = _into_ball(start, ways) if self.round else _into_cube(start, ways)
            points = start + far[:, None] * ways
        return far, points

    def surface(self, count: int, rng: np.random.Generator) -> Floats:
        """Return points (count, 3) of the unplaced surface."""
        points = rng.normal(size=(count, 3))
        order = 2 if self.round else np.inf
        return points / np.linalg.norm(points, ord=order, axis=1, keepdims=True)


def _textures(seed: int, texels: int, tint: Sequence[float]) -> list[Floats]:
    """Return textures of six sides, each half tint, half a part of a pattern."""
    return [(pattern(seed + side)[:texels, :texels] + tint) / 2 for side in range(6)]


THINGS = {
    "box": Thing(False, _textures(100, 40, (255, 190, 60))),
    "balloon": Thing(True, _textures(200, 40, (90, 200, 255))),
}
"""What moves."""

COARSE_WALLS = [wall[:128, :128] for wall in WALLS]


def write_capture(
    folder: Path, width: int, frames: int, pixels: float, drift: float, seed: int
) -> Capture:
    """Write a capture as ``gsdmsr prepare`` does, with masks of what moves.

    Args:
        folder: is made.
        width: of the pictures, four thirds of their height [px].
        frames: on the path; every eighth one is a val picture.
        pixels: error of the poses, root mean square [px].
        drift: largest deviation of a colour's factor from 1.
        seed: of the errors and the drift.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0, 1, frames)
    true = [on_path(time, width) for time in times]
    wrong = pose_errors(true, pixels, times, rng, SEEN, distance=3.0)
    given = [corrected(camera, error) for camera, error in zip(true, wrong, strict=True)]
    exposures = exposure_drift(times, drift, rng)
    folder.mkdir(parents=True, exist_ok=True)
    val = np.arange(frames) % 8 == 4
    written: dict[str, list[str]] = {"train": [], "val": [], "test": []}
    entries = []
    for i, time in enumerate(times):
        split = "val" if val[i] else "train"
        opened = time + SHUTTER / (frames - 1) * np.array([-0.5, 0.0, 0.5])
        shots = [_shot(on_path(at, width), at) for at in opened.clip(0, 1)]
        picture = np.mean([shot[0] for shot in shots], axis=0) * exposures[i]
        name = _write(folder, f"{split}{i:03d}", picture, shots[1][1])
        written[split].append(f"images/{name}")
        entries.append(_entry(name, time, given[i]))
    for i, time in enumerate(times[::4]):
        camera = on_path(time, width, OFF_PATH * (-1) ** i)
        name = _write(folder, f"test{i:03d}", *_shot(camera, time))
        written["test"].append(f"images/{name}")
        entries.append(_entry(name, time, camera))
    _write_layout(folder, written, entries, true[0])
    train = (~val).nonzero()[0]
    known = [true[i] for i in train], [given[i] for i in train], exposures[train]
    return Capture(*known, points=SEEN)


def write_rig(folder: Path, width: int, moments: int, around: bool) -> None:
    """Write what 16 cameras that stand still film, and as test pictures what three others do.

    Args:
        folder: is made.
        width: of the pictures, four thirds of their height [px].
        moments: evenly spaced.
        around: whether they stand along the walls and look at the middle of the room; else they
            are a panel on one side and look the same way, as the cameras of Neural 3D Video do.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras = _ring(width) if around else _panel(width)
    written: dict[str, list[str]] = {"train": [], "val": [], "test": []}
    entries = []
    for split, own in cameras.items():
        for i, camera in enumerate(own):
            for moment, time in enumerate(np.linspace(0, 1, moments)):
                name = _write(folder, f"{split}{i:02d}_{moment:03d}", *_shot(camera, time))
                written[split].append(f"images/{name}")
                entries.append(_entry(name, time, camera))
    _write_layout(folder, written, entries, cameras["train"][0])


def _panel(width: int) -> dict[str, list[Camera]]:
    rng = np.random.default_rng(0)
    places = {"train": [(x, z) for x in (-0.9, -0.3, 0.3, 0.9) for z in (-0.5, -1 / 6, 1 / 6, 0.5)]}
    places["test"] = [(0.0, 0.0), (0.6, 0.3), (-0.6, -0.3)]
    found: dict[str, list[Camera]] = {}
    for split, own in places.items():
        shaken = 0.03 if split == "train" else 0.0
        found[split] = [
            _looking(
                np.array([x, -1.6, z]) + shaken * rng.normal(size=3),
                TARGET + np.array([0.4 * x, 0.0, 0.3 * z]),
                width,
            )
            for x, z in own
        ]
    return found


def _ring(width: int) -> dict[str, list[Camera]]:
    middle = np.array([0.0, 0.6, -0.1])
    places = {"train": [(2 * math.pi * k / 16, (-0.2, 0.6)[k % 2]) for k in range(16)]}
    places["test"] = [(2 * math.pi * (5 * k + 0.5) / 16, 0.2) for k in range(3)]
    return {
        split: [_looking(_along_walls(turn, height), middle, width) for turn, height in own]
        for split, own in places.items()
    }


def _along_walls(turn: float, height: float) -> Floats:
    """Return a place within the walls, 2.6 m from the middle at most."""
    way = np.array([math.cos(turn), math.sin(turn)])
    with np.errstate(divide="ignore"):
        reach = min(2.6, *(0.85 * SIZE[:2] / abs(way)))
    return np.array([*(reach * way), height])


def _looking(centre: Floats, target: Floats, width: int) -> Camera:
    height, focal = width * 3 // 4, FOCAL * width
    pose = np.linalg.inv(look_at(centre, target))
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


def seen_points(thing: Thing, time: float, count: int) -> Floats:
    """Return points (P, 3) of the unplaced surface that the walking camera may see at a time.

    Of ``count`` that are drawn; some may lie beside its picture.
    """
    points = thing.surface(count, np.random.default_rng(0))
    centre, _ = _walk(time)
    rays = thing.at(points, time) - centre
    far = [other.meet(centre, rays, time)[0] for other in THINGS.values()]
    own = thing.meet(centre, rays, time)[0]
    return points[(abs(own - 1) < 1e-6) & (np.min(far, axis=0) >= own)]


def on_path(time: float, width: int, aside: float = 0.0) -> Camera:
    """Return the walking camera, turned up by ``aside`` [rad] about the middle of what it sees."""
    centre, target = _walk(time)
    arm = centre - TARGET
    level = math.hypot(arm[0], arm[1])
    turned = math.atan2(arm[2], level) + aside
    reach = math.hypot(level, arm[2])
    arm = np.array([*arm[:2] / level * reach * math.cos(turned), reach * math.sin(turned)])
    return _looking(TARGET + arm, target, width)


def _walk(time: float) -> tuple[Floats, Floats]:
    """Return where the walking camera is, and what it looks at, each (3,)."""
    along = 2 * time - 1
    sway = 0.2 * math.sin(3 * along) + 0.03 * math.sin(40 * time)
    centre = np.array([along, -1.5 + 0.4 * along**2, sway])
    return centre, TARGET + np.array([0.5 * along, 0.0, 0.0])


def _shot(camera: Camera, time: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return a picture (H, W, 3) in [0, 255], of four rays a pixel, and what moves (H, W)."""
    v, u = (np.mgrid[: 2 * camera.height, : 2 * camera.width] + 0.5) / 2
    local = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)]
    rays = np.stack(local, axis=-1).reshape(-1, 3) @ camera.rotation
    nearest, points = out_of_room(camera.centre, rays)
    colours = on_cube(points, COARSE_WALLS)
    moving = np.zeros(len(rays), bool)
    for thing in THINGS.values():
        far, points = thing.meet(camera.centre, rays, time)
        here = far < nearest
        colours[here] = on_cube(points[here], thing.textures)
        moving |= here
        nearest = np.minimum(nearest, far)
    tiles = camera.height, 2, camera.width, 2
    picture = colours.reshape(*tiles, 3).mean((1, 3)) * DIMMED
    return picture, moving.reshape(tiles).any((1, 3))


def _into_cube(start: Floats, ways: Floats) -> Floats:
    first, second = (-1 - start) / ways, (1 - start) / ways
    entry, leave = np.minimum(first, second).max(1), np.maximum(first, second).min(1)
    return np.where((entry < leave) & (entry > 0), entry, np.inf)


def _into_ball(start: Floats, ways: Floats) -> Floats:
    a, b = (ways**2).sum(1), ways @ start
    root = np.sqrt(b**2 - a * (start @ start - 1))
    entry = (-b - root) / a
    return np.where(entry > 0, entry, np.inf)  # NaN where missed


def _write(folder: Path, name: str, picture: Floats, moving: NDArray[np.bool_]) -> str:
    eight = np.rint(picture.clip(0, 255)).astype(np.uint8)
    write_picture(folder / "images" / f"{name}.png", eight)
    masks = np.repeat(moving[..., None], 3, axis=2).astype(np.uint8) * 255
    write_picture(folder / "masks" / f"{name}.png", masks)
    return f"{name}.png"


def _write_layout(
    folder: Path, written: dict[str, list[str]], entries: list[dict[str, object]], camera: Camera
) -> None:
    """Write what tells of the pictures, all taken through the lens of ``camera``."""
    lists = {f"{split}_filenames": names for split, names in written.items()}
    lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    sizes = {"w": camera.width, "h": camera.height, "camera_model": "OPENCV"}
    document = {**lens, **sizes, **lists, "frames": entries}
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
    described = {"gsdmsr": 1, "bound": float(SIZE.max())}
    (folder / "scene.json").write_text(json.dumps(described), encoding="utf-8")


def _entry(name: str, time: float, camera: Camera) -> dict[str, object]:
    paths = {"file_path": f"images/{name}", "motion_mask_path": f"masks/{name}"}
    return {**paths, "time": float(time), "transform_matrix": opengl_pose(camera).tolist()}
