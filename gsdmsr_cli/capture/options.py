"""The options of ``gsdmsr prepare``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

CAMERA_MODELS = (
    "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
)  # fmt: skip
MATCHINGS = ("auto", "sequential", "exhaustive", "both")

FRAMES_OF_RIG = 60
"""Frames of each camera that are taken of a rig unless something else is asked for."""


@dataclass(frozen=True)
class Options:
    """How a capture becomes a scene; every value changes what is written.

    Attributes:
        frames: most frames to take, of each camera of a rig.
        keyframes: most of them from which COLMAP finds cameras and points; the others are placed
            between these. Of no account for a rig.
        offsets: seconds by which the clocks of a rig's cameras are ahead, by name.
        max_side: longer side of the pictures, which are shrunk to it [px].
        features: most features of a frame.
        camera_model: COLMAP's name of the lens that all frames share.
        matching: which frames are compared: neighbours in time, all, or neighbours and, of a few
            evenly chosen, all; ``auto`` is exhaustive for small folders of pictures.
        auto_mask: whether masks of what moves are computed, with the cameras of a first pass.
        mark_motion: whether masks of what moves in a video are computed, by the cameras that are
            found, where there are no others.
        mapping: COLMAP's global mapper or its incremental one.
        min_registered: share of the frames whose cameras must be found.
        test_every: every so many frames one is kept for testing; 0 keeps none. Of a rig it is the
            first camera.
        seed: of COLMAP's random choices.
    """

    frames: int = 240
    keyframes: int = 60
    offsets: Mapping[str, float] = field(default_factory=dict)
    max_side: int = 1600
    features: int = 2048
    camera_model: str = "SIMPLE_RADIAL"
    matching: str = "auto"
    auto_mask: bool = False
    mark_motion: bool = True
    mapping: str = "global"
    min_registered: float = 0.75
    test_every: int = 8
    seed: int = 0
