"""A tiny Neural 3D Video data set for tests: three cameras whose films get brighter."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsdmsr_cli.scene.native import cv2

CAMERAS, FRAMES = 3, 5
WIDTH, HEIGHT = 64, 48


def encode(path: Path, frames: int = FRAMES, width: int = WIDTH, height: int = HEIGHT) -> None:
    """Write frames that get brighter, in the camera's own tint."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (width, height))
    assert writer.isOpened()
    for i in range(frames):
        picture = np.full((height, width, 3), 40 * i + 20, np.uint8)
        writer.write(picture)
    writer.release()


def row(i: int) -> list[float]:
    """A camera at (i, 0, 0) that looks along world z, y down, as LLFF writes it."""
    right, down, back = [1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]
    centre, size = [float(i), 0, 0], [HEIGHT, WIDTH, 60.0]
    table = np.stack([down, right, back, centre, size], axis=1)  # columns
    return [*table.ravel().tolist(), 1.0, 16.0]


def write_n3v(folder: Path) -> Path:
    """Write the videos and poses into a folder, and return it."""
    for i in range(CAMERAS):
        encode(folder / f"cam{i:02d}.mp4")
    np.save(folder / "poses_bounds.npy", [row(i) for i in range(CAMERAS)])
    return folder
