"""Finds where a video has been cut: what lies before and after is not one shot of one scene."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.native import cv2

Thumbnail = NDArray[np.float32]

SIDE = 32
"""Pictures are compared as thumbnails of this many pixels squared."""

LEAST = 12.0
"""A cut changes thumbnails by at least this in the mean [8-bit values]."""

TIMES = 4.0
"""It changes them at least so many times as much as the frames around it."""

BESIDE, AROUND = 3, 8
"""So many changes before and after one: all are to be small, and the median of those around it."""


def thumbnail(picture: NDArray[np.uint8]) -> Thumbnail:
    """Return (H, W, 3) pixels at a size at which grain, and a camera that shakes, are gone."""
    return np.asarray(
        cv2.resize(picture, (SIDE, SIDE), interpolation=cv2.INTER_AREA), dtype=np.float32
    )


def change(before: Thumbnail, after: Thumbnail) -> float:
    """Return the mean absolute difference of two thumbnails [8-bit values]."""
    return float(np.abs(before - after).mean())


def find_cuts(changes: Sequence[float]) -> list[int]:
    """Return the indices of the frames that a cut lies before.

    A shaking or quickly turning camera changes many frames alike, and a flash some that follow each
    other, so only a change that stands alone is a cut. Fades are not found, nor shots of less than
    four frames.

    Args:
        changes: of N frames, the N - 1 changes from each to the next.
    """
    values = np.asarray(changes, dtype=np.float64)
    cuts = []
    for i, value in enumerate(values):
        beside, around = _about(values, i, BESIDE), _about(values, i, AROUND)
        usual = max(beside.max(initial=0.0), np.median(around) if len(around) else 0.0)
        if value >= LEAST and value >= TIMES * usual:
            cuts.append(i + 1)
    return cuts


def _about(values: NDArray[np.float64], i: int, reach: int) -> NDArray[np.float64]:
    """Return so many values before and after one, as far as there are."""
    return np.concatenate([values[max(i - reach, 0) : i], values[i + 1 : i + 1 + reach]])


def longest_shot(times: Sequence[float], cuts: Sequence[int]) -> slice:
    """Return which frames the shot has that lasts longest, the first of equal ones."""
    ends = [0, *cuts, len(times)]
    shots = [slice(a, b) for a, b in itertools.pairwise(ends)]
    return max(shots, key=lambda shot: times[shot.stop - 1] - times[shot.start])
