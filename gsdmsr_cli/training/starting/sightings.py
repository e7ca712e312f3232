"""Projects points to the train views and reads their colours there."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene

VIEWS = 40
"""Most views from which the colours of points are read, evenly spaced."""


class Points(NamedTuple):
    """Points to start from.

    Attributes:
        means: (P, 3) [world units].
        colours: (P, 3) in [0, 1].
        times: (P,) at which they were seen, in [0, 1]; NaN where that is not known.
    """

    means: Tensor
    colours: Tensor
    times: Tensor


def at_unknown_times(means: Tensor, colours: Tensor) -> Points:
    """Return points of which it is not known when they were seen."""
    return Points(means, colours, torch.full((len(means),), torch.nan))


def places(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Return the columns and rows [px] of points (P, 3), and whether the picture shows them."""
    rotation = torch.as_tensor(camera.rotation, dtype=points.dtype)
    at = points @ rotation.T + torch.as_tensor(camera.translation, dtype=points.dtype)
    depth = at[:, 2].clamp(min=1e-6)
    column = at[:, 0] / depth * camera.fx + camera.cx
    row = at[:, 1] / depth * camera.fy + camera.cy
    across = (column >= 0) & (column < camera.width)
    return column, row, (at[:, 2] > 0) & across & (row >= 0) & (row < camera.height)


def coarse_picture(picture: Tensor, side: int) -> tuple[Tensor, int]:
    """Return every n-th pixel (h, w, 3) of a picture (3, H, W), and n.

    The shorter side has ``side`` of them or somewhat more, or all where it is shorter than that.
    """
    stride = max(1, min(picture.shape[1:]) // side)
    return picture[:, ::stride, ::stride].permute(1, 2, 0), stride


def coarse_places(points: Tensor, camera: Camera, stride: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return rows and columns (P,) of points (P, 3) in every ``stride``-th pixel, and who is shown.

    Of points that the picture does not show, rows and columns are of some pixel.
    """
    across, down, shown = places(points, camera)
    column = (across / stride).long().clamp(0, (camera.width - 1) // stride)
    row = (down / stride).long().clamp(0, (camera.height - 1) // stride)
    return row, column, shown


def spread(chosen: Tensor, candidates: int, bound: float, generator: torch.Generator) -> Tensor:
    """Return points (P, 3) of the box, each somewhere about one that was chosen of candidates.

    A small thing holds fewer candidates than points are wanted, so some are chosen many times.

    Args:
        chosen: (P, 3) of them.
        candidates: how many fill the box evenly.
        bound: half edge of the box.
        generator: source of the random places.
    """
    spacing: float = 2 * bound / candidates ** (1 / 3)
    means = chosen + spacing * (torch.rand(len(chosen), 3, generator=generator) - 0.5)
    return means.clamp(-bound, bound)


def colours_of(points: Tensor, scene: Scene, pictures: Pictures) -> Tensor:
    """Return the mean colour of the pixels that points (P, 3) fall on, (P, 3) in [0, 1].

    What hides a point counts as well, for want of knowing it; points that no view shows are grey.
    """
    if not len(points):
        return torch.zeros(0, 3)
    views = scene.split("train")
    total, seen = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for view in views[:: -(-len(views) // VIEWS)]:
        column, row, shown = places(points, pictures.camera(view))
        pixels = pictures.load(view)[:, row[shown].long(), column[shown].long()]
        total[shown] += pixels.T.float() / 255
        seen[shown] += 1
    return torch.where(seen > 0, total / seen.clamp(min=1), 0.5)
