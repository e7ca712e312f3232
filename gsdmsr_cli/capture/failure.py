"""Explains why COLMAP found no cameras, from its matches, and what the user can do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.capture.verified import shared_pixels

FEW_FEATURES = 60
"""Frames with fewer features, in the median, show too little."""

FEW_PAIRS = 0.5
"""Fewer verified pairs of frames than this share of the frames connect nothing."""

STILL = 0.004
"""A camera whose pictures shift by less than this share of their longer side does not move."""


def why_no_model(colmap: Any, database: Path) -> str:
    """Return one sentence about a database of matches from which no model could be begun."""
    with colmap.Database.open(database) as opened:
        images = opened.read_all_images()
        (camera,) = opened.read_all_cameras()
        pixels = {i.image_id: opened.read_keypoints(i.image_id)[:, :2] for i in images}
        shifts = []
        for k, first in enumerate(images):
            for second in images[k + 1 :]:
                shared = shared_pixels(opened, pixels, first.image_id, second.image_id)
                if shared is not None:
                    moved = shared[1] - shared[0]
                    shifts.append(float(np.median(np.linalg.norm(moved, axis=1))))
    median = int(np.median([len(found) for found in pixels.values()]))
    if median < FEW_FEATURES:
        return (
            f"the frames show too little to find cameras from: {median} features in the median "
            "one; film something with texture, in focus and in enough light"
        )
    if len(shifts) < FEW_PAIRS * len(images):
        return (
            f"the frames do not match: only {len(shifts)} pairs of {len(images)} frames show the "
            "same thing; film more slowly and without cuts, or take more --frames"
        )
    shift = max(shifts) / max(camera.width, camera.height)
    if shift < STILL:
        return (
            "the camera does not move: what stands still is at the same place in all frames; a "
            "scene needs a camera that walks round it"
        )
    return (
        f"no two of {len(images)} frames have been taken from places far enough apart: the camera "
        "only turns, or hardly moves, or something large moves with it: walk round the scene while "
        "filming, or give --masks of what moves"
    )
