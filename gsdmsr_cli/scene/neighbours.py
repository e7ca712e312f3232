"""Which views are neighbours: those that one camera took, moment after moment.

A camera that has hardly moved in between counts as the same one. Cameras that jump between moments,
as in D-NeRF's scenes, have no neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.nearness import MOST_TURN, MOST_WAY, extent
from gsdmsr_cli.scene.scene import View

LEAST_SHARE = 0.1
"""Where fewer of the views than this share have a neighbour, it is by chance that some have."""


def neighbours(
    views: Sequence[View], of: Collection[View] | None = None
) -> dict[View, tuple[View, ...]]:
    """Return the views one moment before and after each, from the same place; perhaps neither.

    Args:
        views: one or more, among which there may be neighbours.
        of: those of them whose neighbours are wanted; all if None.
    """
    wanted = set(views if of is None else of)
    moments: dict[float, list[View]] = {}
    for view in views:
        moments.setdefault(view.time, []).append(view)
    times = sorted(moments)
    centres = np.stack([view.camera.centre for view in views])
    most = MOST_WAY * extent(centres)
    found = {}
    for i, time in enumerate(times):
        beside = [moments[other] for other in (*times[max(i - 1, 0) : i], *times[i + 1 : i + 2])]
        for view in (view for view in moments[time] if view in wanted):
            nearest = (_nearest(view, others, most) for others in beside)
            found[view] = tuple(other for other in nearest if other is not None)
    return found


def _nearest(view: View, others: Sequence[View], most: float) -> View | None:
    """Return the view taken from nearest by, or None if that is too far away."""
    near = [other for other in others if _alike(view.camera, other.camera, most)]
    return min(near, key=lambda other: _way(view.camera, other.camera), default=None)


def _alike(one: Camera, other: Camera, most: float) -> bool:
    """Return whether a camera is the other one, or has hardly moved since."""
    turn = one.rotation @ other.rotation.T
    cosine = (np.trace(turn) - 1) / 2
    lens = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in (one, other)]
    near = _way(one, other) <= most and cosine >= math.cos(MOST_TURN)
    return bool(near) and lens[0] == lens[1]


def _way(one: Camera, other: Camera) -> float:
    return float(np.linalg.norm(one.centre - other.centre))
