"""Finds points on what moves before cameras that stand still, as their medians over time tell.

What a camera sees at a pixel half of the time or longer is its median over time; what differs from
it, at a time, moves. Where that is so for most of the cameras that see a place, something is there.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.starting.sightings import (
    Points,
    at_unknown_times,
    coarse_picture,
    coarse_places,
    spread,
)

DIFFERENCE = 24
"""A pixel differs if a channel does so this much [1/255]: more than noise and faint shadows do."""

MOMENTS, LOOKED_AT = 5, 16
"""Least pictures of a camera of which a median is taken, and most, evenly spaced."""

GRID = 180
"""Pictures are sampled at about so many pixels along the shorter side."""

CANDIDATES = 200_000
"""Random places that are looked at in the box."""

CAMERAS = 4
"""Least cameras that must see a place; two that see something else than usual meet by chance."""

SHARE = 0.75
"""Share of them for which it must differ: others may have something of its colour behind it."""

_NONE = at_unknown_times(torch.zeros(0, 3), torch.zeros(0, 3))


@dataclass(frozen=True, eq=False)
class _Watch:
    """What a camera that stands still sees over time.

    Attributes:
        camera: of the whole pictures.
        stride: how many pixels of the whole picture lie between two of the coarse one.
        moments: (T,) rows of the times at which it is looked at.
        pixels: (T, h, w, 3) uint8, the coarse pictures at these.
        changed: (T, h, w) bool, what differs from their median.
    """

    camera: Camera
    stride: int
    moments: Tensor
    pixels: Tensor
    changed: Tensor

    def colours(self, points: Tensor, moments: Tensor) -> tuple[Tensor, Tensor]:
        """Return the colours (P, 3) in [0, 1] where points (P, 3) fall, and which of them differ.

        Each is looked at in the moment of its row of ``moments`` (P,).
        """
        row, column, shown = coarse_places(points, self.camera, self.stride)
        same = self.moments == moments[:, None]
        at = same.int().argmax(dim=1)
        differs = same.any(dim=1) & shown & self.changed[at, row, column]
        return self.pixels[at, row, column] / 255, differs


def sample_points(
    scene: Scene, pictures: Pictures, count: int, generator: torch.Generator
) -> Points:
    """Return ``count`` points of the box on what moves, with the times at which it is there.

    There are none where too few cameras stand still, or nothing moves before enough of them. A
    moment has points by how much room what moves takes in it. The colour is the mean of the pixels
    that a point falls on where they differ.

    Args:
        scene: gives views and box.
        pictures: the train pictures.
        count: number of points.
        generator: source of the random points.
    """
    if not count:
        return _NONE
    times = scene.train_times[:: -(-len(scene.train_times) // LOOKED_AT)]
    watches = _watches(scene, pictures, times)
    if not watches:  # nothing is drawn at random, so all else is as if it had not been tried
        return _NONE
    candidates = (2 * torch.rand(CANDIDATES, 3, generator=generator) - 1) * scene.bound
    shown, differs = torch.zeros(2, len(times), CANDIDATES, dtype=torch.int16)
    for watch in watches:
        row, column, visible = coarse_places(candidates, watch.camera, watch.stride)
        shown[watch.moments] += visible
        differs[watch.moments] += visible & watch.changed[:, row, column]
    moments, rows = torch.nonzero((shown >= CAMERAS) & (differs >= SHARE * shown), as_tuple=True)
    if not len(rows):
        return _NONE
    chosen = torch.randint(len(rows), (count,), generator=generator)
    means, moments = candidates[rows[chosen]], moments[chosen]
    colours, seen = torch.zeros(count, 3), torch.zeros(count, 1)
    for watch in watches:
        own, differ = watch.colours(means, moments)
        colours += own * differ[:, None]
        seen += differ[:, None]
    means = spread(means, CANDIDATES, scene.bound, generator)
    return Points(means, colours / seen, torch.tensor(times)[moments])


def _watches(scene: Scene, pictures: Pictures, times: list[float]) -> list[_Watch]:
    """Return the cameras that stand still, or none if those are too few."""
    rows = {time: row for row, time in enumerate(times)}
    by_pose: dict[bytes, list[View]] = defaultdict(list)
    for view in scene.split("train"):
        if view.time in rows:
            by_pose[view.camera.rotation.tobytes() + view.camera.translation.tobytes()].append(view)
    still = [views for views in by_pose.values() if len(views) >= MOMENTS]
    if len(still) < CAMERAS:
        return []
    return [_watch(views, pictures, [rows[view.time] for view in views]) for views in still]


def _watch(views: list[View], pictures: Pictures, moments: list[int]) -> _Watch:
    camera = pictures.camera(views[0])
    taken, strides = zip(
        *(coarse_picture(pictures.load(view), GRID) for view in views), strict=True
    )
    pixels = torch.stack(taken)
    differences = (pixels.float() - pixels.float().median(dim=0).values).abs()
    changed = differences.amax(dim=3) > DIFFERENCE
    return _Watch(camera, strides[0], torch.tensor(moments), pixels, changed)
