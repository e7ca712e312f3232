"""What a film is: a camera and a moment for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.scene import View

MADE_FPS, VIEWS_FPS = 30.0, 10.0
"""Frames a second of films of cameras that nobody held, and of those in the data."""


ORIGIN = (0.0, 0.0, 0.0)
"""Of the world: formats centre the scene there, see ``Scene.bound``."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame of a film.

    Attributes:
        camera: gives the frame's size.
        time: the moment in [0, 1].
        view: whose picture shows the same, if there is one.
    """

    camera: Camera
    time: float
    view: View | None = None


@dataclass(frozen=True, eq=False)
class Film:
    """What one path shows.

    Attributes:
        name: of the path; the pictures go to a folder and the video to a file of that name.
        shots: one for every frame, in order.
        fps: frames a second of the video.
    """

    name: str
    shots: tuple[Shot, ...]
    fps: float


@dataclass(frozen=True)
class PathOptions:
    """What may be asked of a path, or is told to it; none takes all of it.

    Attributes:
        frames: number of frames.
        views: names of views, as ``find_view`` takes them.
        centre: the point that cameras go round [world units]: the middle of what was
            reconstructed, where that is known.
    """

    frames: int | None = None
    views: tuple[str, ...] = ()
    centre: tuple[float, float, float] = ORIGIN


def moments(count: int) -> list[float]:
    """Return ``count`` moments evenly from 0 to 1, both included; a single one is 0."""
    return [i / max(count - 1, 1) for i in range(count)]


def over_time(cameras: Sequence[Camera]) -> list[Shot]:
    """Return a shot of every camera, while time runs from 0 to 1."""
    return [Shot(c, t) for c, t in zip(cameras, moments(len(cameras)), strict=True)]
