"""Finds scale-invariant features (SIFT, Lowe 2004) in every frame with OpenCV.

OpenCV's SIFT is faster on a CPU than the one within COLMAP. Descriptors are
normalised to RootSIFT (Arandjelovic & Zisserman 2012), which COLMAP's matcher expects.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.native import cv2, one_opencv_thread

LONGEST = 960
"""Longer side at which features are searched [px]; finer ones cost time and add little."""

CONTRAST = 0.01
"""Least contrast of a feature; low, so that dim walls have some as well."""


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one frame.

    Attributes:
        pixels: (N, 2) float32 positions in the frame [px].
        descriptors: (N, 128) uint8, RootSIFT times 512.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]

    def where(self, kept: NDArray[np.bool_]) -> Features:
        """Return those of which ``kept``, (N,), holds."""
        return Features(self.pixels[kept], self.descriptors[kept])


def write_features(
    folder: Path, pictures: Sequence[Path], count: int, on_progress: OnProgress
) -> None:
    """Write the ``count`` strongest features of each picture to a file of its name."""

    def work(path: Path) -> None:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found = find_features(np.asarray(grey, dtype=np.uint8), count)
        np.savez(folder / path.stem, pixels=found.pixels, descriptors=found.descriptors)

    # a thread per picture, each by itself: the order of what OpenCV's own threads find varies
    with one_opencv_thread():
        pool = ThreadPoolExecutor(cores())
        try:
            for done, _ in enumerate(pool.map(work, pictures), start=1):
                on_progress(done, len(pictures))
        finally:
            pool.shutdown(cancel_futures=True)


def read_features(folder: Path, name: str) -> Features:
    """Return the features of the picture ``name``."""
    with np.load(folder / f"{Path(name).stem}.npz") as arrays:
        return Features(arrays["pixels"], arrays["descriptors"])


def find_features(grey: NDArray[np.uint8], count: int) -> Features:
    """Return the ``count`` strongest features of (H, W) pixels."""
    height, width = grey.shape
    scale = min(1.0, LONGEST / max(width, height))
    if scale < 1:
        shape = round(width * scale), round(height * scale)
        grey = np.asarray(cv2.resize(grey, shape, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(grey, None)
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.uint8))
    shrunk = np.array([grey.shape[1], grey.shape[0]])
    # OpenCV counts from the centre of the first pixel, COLMAP from its corner
    pixels = (np.array([point.pt for point in points]) + 0.5) * np.array([width, height]) / shrunk
    return Features(pixels.astype(np.float32), _root_sift(np.asarray(descriptors, np.float32)))


def _root_sift(descriptors: NDArray[np.float32]) -> NDArray[np.uint8]:
    shares = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    rounded: NDArray[np.uint8] = np.rint(512 * np.sqrt(shares)).clip(0, 255).astype(np.uint8)
    return rounded
