"""The options of ``gsdmsr render``, checked as far as that is possible without the run."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

from gsdmsr_cli.ground.errors import UsageError, nearest

OUTPUTS = ("rgb", "depth", "alpha", "flow", "error")
VIDEOS = ("webm", "mp4", "webp")
MOST_PIXELS = 16384
"""Largest side of what is drawn [px]."""


@dataclass(frozen=True)
class Request:
    """The options of ``gsdmsr render``.

    Attributes:
        path: see ``paths.make_film``; None for the test views and the orbit.
        frames, views, time, fps: see there.
        outputs: what to write of every frame, of ``OUTPUTS``.
        videos: kinds of videos, of ``VIDEOS``.
        size: width and height of the pictures [px], or None for those of training.
        scale: factor on the size of training.
        supersample: each pixel is the mean of so many squared.
        overwrite: draw frames anew that are there already.

    Raises:
        UsageError: two options exclude each other, or one is out of range.
    """

    path: str | None = None
    frames: int | None = None
    views: tuple[str, ...] = ()
    time: float | None = None
    fps: float | None = None
    outputs: tuple[str, ...] = ("rgb",)
    videos: tuple[str, ...] = ("webm",)
    size: tuple[int, int] | None = None
    scale: float | None = None
    supersample: int = 1
    overwrite: bool = False

    def __post_init__(self) -> None:
        if self.size is not None and self.scale is not None:
            raise UsageError("--size and --scale are both given; drop one")
        if self.scale is not None and not (math.isfinite(self.scale) and self.scale > 0):
            raise UsageError(f"--scale is {self.scale:g}; allowed: more than 0")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise UsageError(f"--fps is {self.fps:g}; allowed: more than 0, up to 1000")
        if self.path == "still" and self.time is not None:
            raise UsageError("--time stops time and --path still stops the camera; drop one")
        if "flow" in self.outputs and self.frames == 1:
            raise UsageError("--output flow is from one frame to the next; --frames 1 has no next")
        if self.path is None and self.views:
            raise UsageError("--view needs a --path that goes by views: still, dolly, interpolate")


def outputs_of(text: str) -> tuple[str, ...]:
    """Return the outputs that ``--output`` names, in their usual order."""
    return _some_of(OUTPUTS, text, "--output")


def videos_of(text: str) -> tuple[str, ...]:
    """Return the kinds of videos that ``--video`` names; "none" are none."""
    return () if text.strip() == "none" else _some_of(VIDEOS, text, "--video")


def size_of(text: str) -> tuple[int, int]:
    """Return width and height that ``--size`` names, such as 640x360."""
    match = re.fullmatch(r"\s*(\d{1,6})\s*[xX]\s*(\d{1,6})\s*", text)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not all(1 <= side <= MOST_PIXELS for side in size):
        raise UsageError(
            f"--size is '{text}'; allowed: WxH, both 1 to {MOST_PIXELS} px, such as 640x360"
        )
    return size


def _some_of(known: Iterable[str], text: str, option: str) -> tuple[str, ...]:
    words = [word.strip() for word in text.split(",")]
    for word in words:
        if word not in known:
            raise UsageError(f"{option}: unknown '{word}'; {nearest(word, known)}")
    return tuple(name for name in known if name in words)
