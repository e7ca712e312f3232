"""Colours of directions in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from gsdmsr_cli.scene.camera import Camera

BESIDE = ((1, 2), (2, 0), (0, 1))
"""Of each axis the two others, which span the faces that it goes through."""


def show_behind_twin(
    rgb: Tensor, alpha: Tensor, colours: Tensor, points: Tensor, camera: Camera
) -> Tensor:
    """Return what ``show_behind`` does, for any device and dtype."""
    ways = directions(camera).to(rgb)
    return rgb + (1 - alpha)[..., None] * look(ways, colours, points)


def look(ways: Tensor, colours: Tensor, points: Tensor) -> Tensor:
    """Return the colours in directions (..., 3) of any length but 0, linear between points."""
    size = points.shape[1]
    face, u, v = _faces(ways)
    row = (u + 1) / 2 * (size - 1) + size * face
    places = torch.stack([v, 2 * row / (6 * size - 1) - 1], dim=-1)
    atlas = colours[points].flatten(0, 1).permute(2, 0, 1)  # faces in one column
    found = grid_sample(atlas[None], places.view(1, 1, -1, 2).to(atlas), align_corners=True)
    return found[0, :, 0].T.view(ways.shape)


def _faces(ways: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return which of the six faces directions (..., 3) go through, and where: -1 to 1, twice."""
    reach, axis = ways.abs().max(dim=-1, keepdim=True)
    beside = torch.tensor(BESIDE, device=ways.device)[axis[..., 0]]
    u, v = (ways.gather(-1, beside) / reach).unbind(dim=-1)
    ahead = ways.gather(-1, axis)[..., 0] > 0
    return 2 * axis[..., 0] + ahead, u, v


def directions(camera: Camera) -> Tensor:
    """Return where the pixels of a camera look to in the world, (H, W, 3) float64, not unit."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    right, down, ahead = torch.from_numpy(camera.rotation).double().unbind(dim=0)
    return x[None, :, None] * right + y[:, None, None] * down + ahead
