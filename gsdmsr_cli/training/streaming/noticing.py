"""Finds where something new stands: places at which the errors of several cameras meet.

What the splats cannot show is wrong in every picture that sees it. A place inside it is projected
into such an error by all cameras, one in front of it or behind it only by some: the errors' visual
hull (Laurentini 1994), of places drawn at random, more and more where they have met.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gsdmsr_cli.drawing.depth import depths_of
from gsdmsr_cli.drawing.flow import project
from gsdmsr_cli.ground.splatting_constants import NEAR
from gsdmsr_cli.ops.planes import Box
from gsdmsr_cli.scene.camera import Camera

LEAST_CAMERAS, LEAST_SHARE = 3, 1 / 3
"""A place that fewer cameras see, or a smaller share of them, is not judged."""

HIDDEN = 0.25
"""Share of the cameras that may see something else there, which stands before it."""

_DRAWN, _KEPT, _EACH, _ROUNDS = 20_000, 1_000, 4, 3
"""Places drawn at first; kept as the best; drawn around each of those; how often."""


@dataclass(frozen=True, eq=False)
class Look:
    """A view of the present moment, on the CPU.

    Attributes:
        camera: that it is drawn by.
        errors: (H, W), mean absolute differences of colours from the truth; NaN where the view's
            mask leaves pixels out.
        true: (H, W, 3) its picture in [0, 1].
    """

    camera: Camera
    errors: Tensor
    true: Tensor


class Places(NamedTuple):
    """Where something new stands.

    Attributes:
        means: (M, 3) places [world units].
        colours: (M, 3) what cameras see there.
        apart: how far apart places have been looked for at first [world units]: a place speaks for
            no more than what lies within half of that.
    """

    means: Tensor
    colours: Tensor
    apart: float


@torch.no_grad()
def look(camera: Camera, rgb: Tensor, true: Tensor, mask: Tensor | None) -> Look:
    """Compare a drawn picture (H, W, 3) with a true one (3, H, W) uint8.

    Errors are means over 3 x 3 pixels, so that edges that are off by one are none.
    """
    target = true.cpu().permute(1, 2, 0) / 255
    errors = (rgb.cpu() - target).abs().mean(dim=2)
    errors = avg_pool2d(errors[None], 3, stride=1, padding=1, count_include_pad=False)[0]
    if mask is not None:
        errors = errors.masked_fill(~mask.cpu(), torch.nan)
    return Look(camera, errors, target)


@torch.no_grad()
def find_places(
    looks: Sequence[Look], box: Box, least: float, most: int, generator: torch.Generator
) -> Places:
    """Return up to ``most`` places at which errors above ``least`` meet, chosen at random.

    Args:
        looks: of one moment.
        box: lower and upper corner of where they may be [world units].
        least: error of colours in [0, 1].
        most: how many.
        generator: source of random choices.
    """
    low, high = (torch.tensor(corner, dtype=torch.float32) for corner in box)
    places = low + (high - low) * torch.rand(_DRAWN, 3, generator=generator)
    apart = first = float((high - low).max()) / _DRAWN ** (1 / 3)
    scores = _scores(looks, places)
    for _ in range(_ROUNDS):
        best = scores.topk(_KEPT).indices
        noise = torch.randn(_EACH * _KEPT, 3, generator=generator)
        near = places[best].repeat(_EACH, 1) + apart * noise
        places = torch.cat([places[best], near])
        scores = torch.cat([scores[best], _scores(looks, near)])
        apart /= 2
    found = places[scores > least]
    found = found[torch.randperm(len(found), generator=generator)[:most]]
    colours = torch.stack([_sample(one.true, one, found) for one in looks])
    return Places(found, colours.nanmedian(dim=0).values, first)


def _scores(looks: Sequence[Look], places: Tensor) -> Tensor:
    """Return the error (M,) that all cameras but some see at places (M, 3), 0 if too few do."""
    errors = torch.stack([_sample(one.errors, one, places) for one in looks])
    scores = errors.nanquantile(HIDDEN, dim=0)
    least = max(LEAST_CAMERAS, LEAST_SHARE * len(looks))
    return torch.where(errors.isfinite().sum(dim=0) >= least, scores, 0.0)


def _sample(image: Tensor, one: Look, places: Tensor) -> Tensor:
    """Return what an image (H, W, ...) of a view shows at places (M, 3); NaN outside of it."""
    camera = one.camera
    x, y = project(places, camera).unbind(dim=1)
    ahead = depths_of(places, camera) > NEAR
    inside = ahead & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    column = x.clamp(0, camera.width - 1).long()
    row = y.clamp(0, camera.height - 1).long()
    values = image[row, column]
    return torch.where(inside.view(-1, *[1] * (values.dim() - 1)), values, torch.nan)
