"""Tiny data sets for tests, written with numpy, json and cv2 only."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np


def pose(azimuth: float = 0.3, elevation: float = 0.4, distance: float = 4.0) -> list[list[float]]:
    """A camera-to-world matrix in OpenGL axes on a sphere around the origin, facing it."""
    backward = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(backward, right), backward, distance * backward], 1)
    return matrix.tolist()


def write_picture(path: Path, pixels: np.ndarray) -> None:
    """Write (H, W, C) RGB(A) or grey pixels of 8 or 16 bits with cv2."""
    path.parent.mkdir(parents=True, exist_ok=True)
    order = {1: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[pixels.shape[2]]
    assert cv2.imwrite(str(path), np.ascontiguousarray(pixels[..., order]))


def noise(height: int, width: int, channels: int = 4, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def write_json(path: Path, document: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document), encoding="utf-8")


def dnerf_frames(split: str, count: int) -> list[dict[str, Any]]:
    """Frames of one split with times from 0 to 1."""
    return [
        {
            "file_path": f"./{split}/r_{i:03d}",
            "time": i / max(count - 1, 1),
            "transform_matrix": pose(azimuth=0.2 + 0.5 * i),
        }
        for i in range(count)
    ]


def write_colmap(folder: Path, names: list[str], camera: str = "1 PINHOLE 10 8 9 9 5 4") -> Path:
    """Write a COLMAP model as text, with pictures of 10 x 8 px of those names that are plain."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"{camera}\n")
    lines = [f"{i} 1 0 0 0 {0.1 * i} 0 4 1 {name}\n\n" for i, name in enumerate(names)]
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("1 0 0 0 255 128 0 0.5 1 2\n")
    for name in names:
        if "/" not in name and len(name) < 100:
            write_picture(folder / "images" / name, noise(8, 10, 3))
    return folder


def write_dnerf(folder: Path, train: int = 3, val: int = 2, test: int = 2) -> Path:
    """Write a D-NeRF data set of 10 x 8 px RGBA pictures and return its folder."""
    for split, count in (("train", train), ("val", val), ("test", test)):
        frames = dnerf_frames(split, count)
        for i, frame in enumerate(frames):
            write_picture(folder / f"{frame['file_path']}.png", noise(8, 10, seed=i))
        document = {"camera_angle_x": 0.7, "frames": frames}
        write_json(folder / f"transforms_{split}.json", document)
    return folder
