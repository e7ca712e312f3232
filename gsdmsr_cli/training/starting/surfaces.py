"""Finds points on surfaces, at the depths at which neighbouring train views agree.

A plane sweep (Collins 1996) along the rays of random pixels: whatever is still, or moves little
from one view to the next, looks alike in all views at its own depth, and at no other.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import MASK, Scene
from gsdmsr_cli.training.starting.sightings import Points, places

VIEWS = 48
"""At most so many views send out rays, evenly spaced."""

PARTNERS = 8
"""Views that each is compared with, the nearest in space and time."""

BASELINE = 0.1
"""How far their cameras stand from its own and from one another, in units of the cameras' spread.

Without that, all of them could be frames of one camera that stands still.
"""

UNLIKE = 0.1
"""Difference of colours that says no more than "another thing", so that what is hidden in a few
views, or has moved, does not outweigh the others."""

NEAREST = 0.5
"""Least depth that is tried [world units]."""

DEPTHS, FINER = 40, 12
"""Depths that are tried, evenly in their inverse, and then about the best of them."""

SIDE = 200
"""Pictures are shrunk to about so many pixels along the shorter side."""

KEPT = 64
"""Shrunk pictures in memory at a time; partners of a view are often those of the next as well."""

PATCH = ((0, 0), (-2, -2), (0, -2), (2, -2), (-2, 0), (2, 0), (-2, 2), (0, 2), (2, 2))
"""Pixels that are compared together, the first of which sends out the ray."""

CANDIDATES = 2
"""Rays per point wanted; those whose depth is clearest are likeliest to be taken."""


def sample_points(
    scene: Scene, pictures: Pictures, count: int, generator: torch.Generator
) -> Points:
    """Return points on what the train views see, in their colours; fewer views, vaguer depths.

    Args:
        scene: gives views and the box, which bounds the depths.
        pictures: the train pictures.
        count: number of points.
        generator: source of the random pixels.
    """
    album = _Album(scene, pictures)
    senders = range(0, len(album), -(-len(album) // VIEWS))
    rays = -(-CANDIDATES * count // len(senders))
    found = [_sweep(album, sender, rays, generator) for sender in senders]
    means, colours, clearness = (torch.cat(parts) for parts in zip(*found, strict=True))
    rows = torch.multinomial(clearness + 1e-6, count, generator=generator)
    times = torch.tensor([album.time(sender) for sender in senders]).repeat_interleave(rays)
    return Points(means[rows], colours[rows], times[rows])


class _Album:
    """The train views, shrunk, and who is near whom.

    Attributes:
        cameras: of the shrunk pictures.
        nearest, farthest: depths between which surfaces are looked for [world units].
    """

    def __init__(self, scene: Scene, pictures: Pictures) -> None:
        self._views = scene.split("train")
        self._pictures = pictures
        self.cameras = [_shrunk(pictures.camera(view)) for view in self._views]
        self._loaded: dict[int, Tensor] = {}
        self._centres = np.stack([camera.centre for camera in self.cameras])
        self._times = np.array([view.time for view in self._views])
        self._spread = np.linalg.norm(self._centres - self._centres.mean(axis=0), axis=1).max()
        reach = float(np.linalg.norm(self._centres, axis=1).max())
        self.nearest, self.farthest = NEAREST, reach + scene.bound

    def __len__(self) -> int:
        return len(self._views)

    def time(self, row: int) -> float:
        """Return the time of a view."""
        return self._views[row].time

    def partners(self, row: int) -> list[int]:
        """Return the views to compare a view with."""
        apart = np.linalg.norm(self._centres - self._centres[row], axis=1)
        later = np.abs(self._times - self._times[row])
        least = BASELINE * self._spread
        chosen: list[int] = []
        for other in np.argsort(apart / max(self._spread, 1e-9) + later, kind="stable"):
            taken = self._centres[[row, *chosen]]
            if np.linalg.norm(taken - self._centres[other], axis=1).min() > least:
                chosen.append(int(other))
            if len(chosen) == PARTNERS:
                break
        return chosen

    def picture(self, row: int) -> Tensor:
        """Return a shrunk picture, (3, h, w) in [0, 1]."""
        small = self._loaded.pop(row, None)
        if small is None:
            camera = self.cameras[row]
            pixels = self._pictures.load(self._views[row]).permute(1, 2, 0).numpy().astype("f4")
            shrunk = imaging.resize_area(pixels, camera.width, camera.height) / 255
            small = torch.from_numpy(shrunk).permute(2, 0, 1).contiguous()
        self._loaded[row] = small  # behind the others, the last of all to go
        if len(self._loaded) > KEPT:
            del self._loaded[next(iter(self._loaded))]
        return small

    def counted(self, row: int, pixels: Tensor) -> Tensor:
        """Return which pixels (P, 2) of a shrunk picture count, (P,) bool."""
        counted = self._pictures.signal(self._views[row], MASK)
        if counted is None:
            return torch.ones(len(pixels), dtype=torch.bool)
        height, width = counted.shape
        camera = self.cameras[row]
        column = (pixels[:, 0] * (width / camera.width)).long().clamp(max=width - 1)
        line = (pixels[:, 1] * (height / camera.height)).long().clamp(max=height - 1)
        return counted[line, column]


def _shrunk(camera: Camera) -> Camera:
    by = max(1.0, min(camera.width, camera.height) / SIDE)
    return camera.resized(max(1, round(camera.width / by)), max(1, round(camera.height / by)))


def _sweep(
    album: _Album, row: int, rays: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a point on each of some random rays of a view, its colour, and how clear its depth is.

    Clear is what agrees much better at one depth than at the others, up to 1; 0 is what does not
    count.
    """
    camera = album.cameras[row]
    at = torch.rand(rays, 2, generator=generator) * torch.tensor([camera.width, camera.height])
    patch = at[:, None] + torch.tensor(PATCH, dtype=torch.float32)
    wanted = _sample(album.picture(row), patch.reshape(-1, 2)).view(rays, len(PATCH), 1, 3)
    far, near = 1 / album.farthest, 1 / album.nearest
    step = (near - far) / DEPTHS
    steps = torch.arange(DEPTHS) + torch.rand(rays, DEPTHS, generator=generator)
    inverse = far + step * steps
    cost = _cost(album, row, patch, wanted, inverse)
    # of equals, as where there are no partners, any may be taken
    cost += 1e-6 * torch.rand(rays, DEPTHS, generator=generator)
    least, index = cost.min(dim=1)
    clearness = (1e-3 + 1 - least / cost.median(dim=1).values) * album.counted(row, at)
    best = inverse.gather(1, index[:, None])
    inverse = (best + step * torch.linspace(-1, 1, FINER)).clamp(far, near)
    index = _cost(album, row, patch, wanted, inverse).argmin(dim=1)
    depth = 1 / inverse.gather(1, index[:, None])
    means = _unproject(at, depth[:, 0], camera)
    return means, wanted[:, 0, 0], clearness


def _cost(album: _Album, row: int, patch: Tensor, wanted: Tensor, inverse: Tensor) -> Tensor:
    """Return how unlike a view's partners see patches of it at each of some depths, (R, D).

    Args:
        patch: (R, patch, 2) pixels of the view.
        wanted: (R, patch, 1, 3) their colours.
        inverse: (R, D) inverse depths.
    """
    points = _unproject(patch[:, :, None], 1 / inverse[:, None], album.cameras[row])
    cost = torch.zeros(inverse.shape)
    partners = album.partners(row)
    for partner in partners:
        column, line, shown = places(points.reshape(-1, 3), album.cameras[partner])
        seen = _sample(album.picture(partner), torch.stack([column, line], dim=1))
        difference = (seen.view(points.shape) - wanted).abs().mean(dim=3)
        difference[~shown.view(difference.shape)] = UNLIKE
        cost += difference.clamp(max=UNLIKE).mean(dim=1) / len(partners)
    return cost


def _unproject(pixels: Tensor, depths: Tensor, camera: Camera) -> Tensor:
    """Return the world points (..., 3) at ``depths`` behind pixels (..., 2)."""
    x = (pixels[..., 0] - camera.cx) / camera.fx * depths
    y = (pixels[..., 1] - camera.cy) / camera.fy * depths
    local = torch.stack([x, y, depths.expand_as(x)], dim=-1)
    rotation = torch.as_tensor(camera.rotation, dtype=torch.float32)
    return (local - torch.as_tensor(camera.translation, dtype=torch.float32)) @ rotation


def _sample(picture: Tensor, places: Tensor) -> Tensor:
    """Return the colours (P, 3) of a picture (3, h, w) at places (P, 2) between its pixels."""
    size = torch.tensor([picture.shape[2], picture.shape[1]])
    grid = (2 * places / size - 1).clamp(-2, 2).view(1, -1, 1, 2)
    taken = torch.nn.functional.grid_sample(
        picture[None], grid, padding_mode="border", align_corners=False
    )
    return taken[0, :, :, 0].T
