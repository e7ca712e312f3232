"""Reads where the train pictures differ from their background, coarsely: the silhouettes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from torch import Tensor

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.starting.sightings import coarse_picture, coarse_places

DIFFERENCE = 8
"""A pixel belongs to the silhouette if a channel differs this much from the background [1/255]."""

VIEWS = 100
"""Most views that are read, evenly spaced."""

GRID = 100
"""Pictures are sampled at about so many pixels along a side, enough for a first guess."""


@dataclass(frozen=True, eq=False)
class Outline:
    """What a train view shows before its background.

    Attributes:
        pixels: (h, w, 3) of the coarse picture, 0 to 255.
        drawn: (h, w) bool, those that differ from the background.
        camera: of the whole picture.
        stride: how many pixels of the whole picture lie between two of the coarse one.
    """

    pixels: Tensor
    drawn: Tensor
    camera: Camera
    stride: int

    def cells(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return rows and columns of points (P, 3) in the coarse picture, and which it shows."""
        return coarse_places(points, self.camera, self.stride)


def outlines(scene: Scene, pictures: Pictures, background: Tensor) -> Iterator[Outline]:
    """Yield the outlines of train views, whose pictures are composited on ``background`` (3,).

    Pictures without a plain background are silhouette all over.
    """
    plain = (background * 255).round()
    views = scene.split("train")
    for view in views[:: -(-len(views) // VIEWS)]:
        picture = pictures.load(view)
        coarse, stride = coarse_picture(picture, GRID)
        pixels = coarse.float()
        drawn = (pixels - plain).abs().amax(dim=2) > DIFFERENCE
        yield Outline(pixels, drawn, pictures.camera(view), stride)
