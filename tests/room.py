"""A room with patterned walls, ray-traced with numpy under cameras that are known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

SIZE = np.array([3.0, 2.4, 1.5])  # half edges of the room [m]
FOCAL = 0.9  # focal length over the width
TEXELS = 256

MOST = 2**14
"""Lookups at once, of which OpenCV bounds the number."""


@dataclass(frozen=True)
class Shots:
    """Pictures (N, H, W, 3), their camera-to-world poses (N, 4, 4) in OpenCV axes, and where the
    thing that moves is to be seen, (N, H, W)."""

    pictures: np.ndarray
    poses: np.ndarray
    moving: np.ndarray


def pattern(seed: int, cells: int = TEXELS) -> np.ndarray:
    """Blotches of several sizes, (cells, cells, 3) in [0, 255]."""
    rng = np.random.default_rng(seed)
    whole = np.zeros((cells, cells, 3))
    for size in (8, 16, 32, 64):
        coarse = rng.uniform(0, 1, (size, size, 3)).astype(np.float32)
        whole += cv2.resize(coarse, (cells, cells), interpolation=cv2.INTER_CUBIC)
    return (whole - whole.min()) / (whole.max() - whole.min()) * 255


WALLS = [pattern(seed) for seed in range(6)]
THING = pattern(99)


def looked_up(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear lookup at u, v in [0, 1]."""
    scale = len(texture) - 1
    map_u, map_v = (u * scale).astype(np.float32), (v * scale).astype(np.float32)
    return cv2.remap(texture.astype(np.float32), map_u, map_v, cv2.INTER_LINEAR)


def out_of_room(origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far along rays (R, 3) walls are, and their points, in half edges of the room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        far = ((np.sign(rays) * SIZE - origin) / rays).min(1)
    return far, (origin + far[:, None] * rays) / SIZE


def on_cube(points: np.ndarray, textures: Sequence[np.ndarray]) -> np.ndarray:
    """Return the colours (P, 3) of points that are projected from the middle onto a cube."""
    axis = abs(points).argmax(1)
    out = np.take_along_axis(points, axis[:, None], 1)
    unit = (points / abs(out) + 1) / 2
    colours = np.empty_like(points)
    for side in range(6):
        which, ahead = side % 3, side >= 3
        here = (axis == which) & ((out[:, 0] > 0) == ahead)
        rows = here.nonzero()[0]
        for some in np.split(rows, range(MOST, len(rows), MOST)):
            if len(some):
                a, b = (unit[some, i][:, None] for i in range(3) if i != which)
                colours[some] = looked_up(textures[side], a, b)[:, 0]
    return colours


def look_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera-to-world in OpenCV axes (x right, y down, z ahead); the world's z is up."""
    ahead = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(ahead, right), ahead, centre], axis=1)
    return pose


def walk(count: int, reach: float = 1.2) -> np.ndarray:
    """Poses on an arc through the room that look at its far side."""
    poses = []
    for along in np.linspace(-1, 1, count):
        centre = np.array([reach * along, -1.5 + 0.4 * along**2, 0.2 + 0.2 * np.sin(3 * along)])
        poses.append(look_at(centre, np.array([0.5 * along, 1.8, -0.1])))
    return np.stack(poses)


def draw(pose: np.ndarray, width: int, height: int, thing: float = 0.0, phase: float = 0.0):
    """Return the picture and where the thing is seen.

    The thing is a patterned board of ``thing`` times the picture's size, 0.8 m ahead of the camera
    and moving with it, which sways as ``phase`` grows.
    """
    focal = FOCAL * width
    v, u = np.mgrid[:height, :width] + 0.5
    local = np.stack([(u - width / 2) / focal, (v - height / 2) / focal, np.ones_like(u)], axis=-1)
    rays = local @ pose[:3, :3].T
    centre = pose[:3, 3]
    _, points = out_of_room(centre, rays.reshape(-1, 3))
    picture = on_cube(points, WALLS).reshape(height, width, 3)
    moving = np.zeros((height, width), bool)
    if thing:
        depth = 0.8
        x = local[..., 0] * depth - 0.05 * np.sin(phase)
        y = local[..., 1] * depth - 0.03 * np.cos(1.3 * phase)
        half_x, half_y = thing * depth / (2 * FOCAL), thing * depth * height / (2 * FOCAL * width)
        moving = (np.abs(x) < half_x) & (np.abs(y) < half_y)
        board = looked_up(THING, x / half_x / 2 + 0.5, y / half_y / 2 + 0.5)
        picture[moving] = board[moving]
    return np.rint(picture).clip(0, 255).astype(np.uint8), moving


def film(poses: np.ndarray, width: int = 320, height: int = 240, thing: float = 0.0) -> Shots:
    """Draw a picture under each pose."""
    drawn = [draw(pose, width, height, thing, 0.5 * i) for i, pose in enumerate(poses)]
    return Shots(np.stack([d[0] for d in drawn]), poses, np.stack([d[1] for d in drawn]))


def write_pictures(folder: Path, shots: Shots) -> Path:
    folder.mkdir(parents=True)
    for i, picture in enumerate(shots.pictures):
        cv2.imwrite(str(folder / f"shot{i:03d}.png"), picture[..., ::-1])
    return folder


def write_film(path: Path, shots: Shots, fps: float = 10.0) -> Path:
    height, width = shots.pictures.shape[1:3]
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, fps, (width, height))
    for picture in shots.pictures:
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    return path


def trajectory_error(centres: np.ndarray, true: np.ndarray) -> float:
    """Root mean square distance after the best similarity (Umeyama 1991), over the length."""
    a, b = centres - centres.mean(0), true - true.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(flip)).sum() / (a**2).sum()
    off = b - scale * a @ (u @ flip @ vt).T
    length = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    return float(np.sqrt((off**2).sum(1).mean()) / length)
