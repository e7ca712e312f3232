"""Finds moving parts: pixels whose optical flow contradicts the motion of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.consistency import essential_matrix, rays_of, sampson_distance
from gsdmsr_cli.capture.frames import Frames
from gsdmsr_cli.capture.masks import NOTE, Mask, write_mask
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.ground.files import write_json
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.optical_flow import Floats32, Grey, ends_of, optical_flow, trusted

LONGEST = 640
"""Longer side at which flow is computed [px]."""

NEIGHBOURS = (-4, -2, 2, 4)
"""Each frame is compared with these, counted in keyframes."""

OFF = 1.5
"""What is so far from its epipolar line moves [px at ``LONGEST``]."""

INCONSISTENT = 1.5
"""Flow there and back that ends so far from its start is not to be trusted [px]."""

SMALLEST = 0.002
"""Smaller patches, as shares of the picture, are mistakes."""


def write_found_masks(
    folder: Path, frames: Frames, found: Reconstruction, keyframes: int, on_progress: OnProgress
) -> None:
    """Write a mask for every frame, empty where it has no camera or nothing to be compared with.

    Args:
        folder: to write.
        frames: the chosen ones.
        found: cameras of a first pass.
        keyframes: how many of them COLMAP has found.
        on_progress: called with how many are done, and of how many.
    """
    scale = min(1.0, LONGEST / max(frames.size))
    width, height = (round(side * scale) for side in frames.size)
    greys = [_grey(frames.folder / name, width, height) for name in found.names]
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    lens = found.lens.resized(width, height)
    rays = rays_of(lens, pixels.reshape(-1, 2).astype(np.float32)).reshape(height, width, 2)
    masks, spacing, flows = {}, max(1, round(len(greys) / keyframes)), Flows(greys)
    for i, name in enumerate(found.names):
        off = off_camera(i, flows, rays, found.poses, spacing)
        masks[name] = cleaned(off * lens.fx > OFF)
        on_progress(i + 1, len(found.names))
    for name in frames.names:
        small = masks.get(name, np.zeros((height, width), bool))
        write_mask(folder / name, small, frames.size)
    write_json(folder / NOTE, {"missing": [n for n in frames.names if n not in masks]})


def _grey(path: Path, width: int, height: int) -> Grey:
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


class Flows:
    """Optical flow between frames, which is kept until the later of two frames asks for it.

    Args:
        greys: (H, W) pictures of all frames, in the order of time, in which they ask.
    """

    def __init__(self, greys: Sequence[Grey]) -> None:
        self.greys = greys
        self._kept: dict[tuple[int, int], tuple[Floats32, Floats32]] = {}

    def there_and_back(self, i: int, j: int) -> tuple[Floats32, Floats32]:
        """Return the flow (H, W, 2) from frame i to j, and that from j to i [px]."""
        if (known := self._kept.pop((j, i), None)) is not None:
            return known[1], known[0]
        found = (
            optical_flow(self.greys[i], self.greys[j]),
            optical_flow(self.greys[j], self.greys[i]),
        )
        if j > i:
            self._kept[i, j] = found
        return found


def off_camera(
    i: int,
    flows: Flows,
    rays: NDArray[np.float64],
    poses: Sequence[NDArray[np.float64]] | NDArray[np.float64],
    spacing: int,
) -> NDArray[np.float64]:
    """Return how far the flow of a frame's pixels is from what its camera's motion does, (H, W).

    In units of rays; the mean over the neighbours, 0 where there are none.

    Args:
        i: the frame.
        flows: between all frames.
        rays: (H, W, 2) directions of the pixels.
        poses: (4, 4) world-to-camera, of all frames.
        spacing: of keyframes [frames].
    """
    count = len(flows.greys)
    others = [i + spacing * step for step in NEIGHBOURS if 0 <= i + spacing * step < count]
    votes = [
        _off_lines(*flows.there_and_back(i, j), rays, essential_matrix(poses[i], poses[j]))
        for j in others
    ]
    return np.asarray(np.mean(votes or [np.zeros(flows.greys[i].shape)], axis=0))


def _off_lines(
    forward: Floats32, back: Floats32, rays: NDArray[np.float64], essential: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return how far each pixel's flow ends from its epipolar line, (H, W), in units of rays.

    0 where the flow is not to be trusted.
    """
    height, width = forward.shape[:2]
    to_x, to_y = ends_of(forward)
    seen = cv2.remap(rays.astype(np.float32), to_x, to_y, cv2.INTER_LINEAR)
    distances = sampson_distance(
        essential, rays.reshape(-1, 2), np.asarray(seen, np.float64).reshape(-1, 2)
    )
    return np.where(trusted(forward, back, INCONSISTENT), distances.reshape(height, width), 0.0)


def cleaned(moving: Mask) -> Mask:
    """Return the mask without specks and without small holes."""
    height, width = moving.shape
    size = max(3, round(0.012 * max(height, width))) | 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    opened = cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_OPEN, disc)
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, disc, iterations=2)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
    large = stats[:, cv2.CC_STAT_AREA] >= SMALLEST * height * width
    large[0] = False
    return np.asarray(large[labels], dtype=np.bool_)
