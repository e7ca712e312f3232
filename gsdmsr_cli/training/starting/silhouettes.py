"""Finds points inside the silhouettes of the train views, where the scene can be."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.starting.outlines import outlines
from gsdmsr_cli.training.starting.sightings import Points, at_unknown_times, spread

CANDIDATES, MOST_CANDIDATES = 20, 500_000
"""Random points per point wanted, and how many at most, for the sake of memory."""

SHARPNESS = 4.0
"""Points are drawn with the probability of their share of silhouettes to this power."""


def sample_points(
    scene: Scene, pictures: Pictures, background: Tensor, count: int, generator: torch.Generator
) -> Points:
    """Return random points in the scene's box, where the train views' silhouettes overlap.

    A point inside a still solid lies in every silhouette, one on a limb that moves in some, one in
    empty space in few. The colour is the mean of the pixels that it falls on inside silhouettes.
    Pictures without a plain background are silhouette all over: then points fill the box evenly.
    Where no view looks points are as dense as in the mean of where some do, for other cameras may.

    Args:
        scene: gives views and box.
        pictures: the train pictures, composited on ``background`` (3,).
        count: number of points.
        generator: source of the random points.
    """
    tried = min(CANDIDATES * count, MOST_CANDIDATES)
    candidates = (2 * torch.rand(tried, 3, generator=generator) - 1) * scene.bound
    inside, seen = torch.zeros(len(candidates)), torch.zeros(len(candidates))
    colours = torch.zeros(len(candidates), 3)
    for outline in outlines(scene, pictures, background):
        row, column, visible = outline.cells(candidates)
        hit = visible & outline.drawn[row, column]
        seen += visible
        inside += hit
        colours += outline.pixels[row, column] / 255 * hit[:, None]
    share = inside / seen.clamp(min=1)
    if not (known := seen > 0).all():  # of what no view sees, the pictures say nothing
        share[~known] = share[known].mean() if known.any() else 0.0
    share = share.clamp(min=1e-3)
    rows = torch.multinomial(share.pow(SHARPNESS), count, replacement=True, generator=generator)
    means = spread(candidates[rows], len(candidates), scene.bound, generator)
    mean_colours = colours / inside.clamp(min=1)[:, None]
    own = torch.where(inside[rows, None] > 0, mean_colours[rows], 0.5)
    return at_unknown_times(means, own)
