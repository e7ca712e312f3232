"""Finds whether train views show things that lie apart from all that stands.

A training begins with what stands: the places that many views see filled. What is joined to it,
such as a limb, is found from there, splat by splat. What lies apart in the picture, such as a ball
that flies, is not: its mean over all moments is transparent, and no splat near says where to go.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.scene.native import cv2, one_opencv_thread
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.starting.outlines import outlines

PLACES = 50
"""Places that are looked at along each side of the scene's box."""

STANDS = 0.5
"""Share of the views in whose silhouettes a place must lie to count as one that stands."""

REACH = 1
"""Cells of the coarse picture about that of a place that it fills as well."""

LEAST = 10
"""Cells of the coarse picture that a thing must have: what is smaller may be noise."""


def views_with_things_apart(scene: Scene, pictures: Pictures, background: Tensor) -> float:
    """Return the share of the train views that show something apart from all that stands.

    Args:
        scene: gives views and box.
        pictures: the train pictures, composited on ``background`` (3,).
    """
    line = (torch.arange(PLACES) + 0.5) / PLACES * 2 - 1
    grid = torch.stack(torch.meshgrid(line, line, line, indexing="ij"), dim=-1)
    places, inside = grid.reshape(-1, 3) * scene.bound, torch.zeros(PLACES**3)
    views = list(outlines(scene, pictures, background))
    for outline in views:
        row, column, visible = outline.cells(places)
        inside += visible & outline.drawn[row, column]
    standing = places[inside >= STANDS * len(views)]
    apart = 0
    for outline in views:
        row, column, visible = outline.cells(standing)
        filled = torch.zeros_like(outline.drawn)
        filled[row[visible], column[visible]] = True
        apart += _has_thing_apart(outline.drawn.numpy(), filled.numpy())
    return apart / len(views)


def _has_thing_apart(drawn: NDArray[np.bool_], filled: NDArray[np.bool_]) -> bool:
    """Return whether a connected part of ``drawn`` (h, w) holds nothing of ``filled`` (h, w)."""
    side = 2 * REACH + 1
    with one_opencv_thread():
        near = cv2.dilate(filled.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        _, labels, parts, _ = cv2.connectedComponentsWithStats(drawn.astype(np.uint8))
    apart = parts[:, cv2.CC_STAT_AREA] >= LEAST
    apart[0] = False  # what is not drawn
    apart[np.unique(labels[near])] = False
    return bool(apart.any())
