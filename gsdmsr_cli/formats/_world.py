"""Normalises a real capture: centres its world and brings it to a common size.

The origin is moved to the middle of what the cameras see, and the scale is chosen such that they
are about as far from it as D-NeRF's cameras. The axes stay.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.scene import View

Floats = NDArray[np.float64]

DISTANCE = 4.0
"""Median depth of what the cameras see [world units]; that of D-NeRF's scenes."""

NEAREST = 0.4
"""Least depth of all but ``STRAYS`` of the points; engines draw nothing nearer than 0.2."""

STRAYS = 0.02
"""Share of the points that may be wrong, or of no interest."""

VIEWS, POINTS = 60, 50_000
"""At most so many views and points are used for it, evenly chosen."""

_LEAST_POINTS = 20


@dataclass(frozen=True, eq=False)
class World:
    """The normalisation of a capture's world: normalised = (own - centre) * scale.

    Attributes:
        centre: (3,) what becomes the origin.
        scale: normalised units per own unit.
        bound: see ``Scene.bound``.
    """

    centre: Floats
    scale: float
    bound: float

    def points(self, points: Floats) -> NDArray[np.float32]:
        """Return (P, 3) points, normalised."""
        return ((points - self.centre) * self.scale).astype(np.float32)

    def views(self, views: Sequence[View]) -> tuple[View, ...]:
        """Return the views with their cameras normalised."""
        return tuple(self._view(view) for view in views)

    def _view(self, view: View) -> View:
        camera = view.camera
        pose = camera.world_to_camera.copy()
        pose[:3, 3] = (camera.rotation @ self.centre + camera.translation) * self.scale
        return replace(view, camera=replace(camera, world_to_camera=pose))


def as_it_is(bound: float) -> World:
    """Return a world that is normalised already."""
    return World(np.zeros(3), 1.0, bound)


def normalize(
    views: Sequence[View], points: Floats, depths: tuple[float, float] | None = None
) -> World:
    """Return the normalised world of a capture.

    Args:
        views: of all splits, in the capture's own world.
        points: (P, 3) on what there is to see; may be empty.
        depths: nearest and farthest depth, where the format gives them.
    """
    chosen = views[:: -(-len(views) // VIEWS)]
    seen = _seen_points(chosen, points[:: -(-len(points) // POINTS or 1)])
    if seen is not None:
        return _from_points(*seen)
    return _from_cameras(chosen, depths)


def _seen_points(views: Sequence[View], points: Floats) -> tuple[Floats, Floats] | None:
    """Return the points that each view shows, one after the other, and their depths; or None."""
    shown, depths = [], []
    for view in views:
        camera = view.camera
        local = points @ camera.rotation.T + camera.translation
        z = np.maximum(local[:, 2], 1e-12)
        u = local[:, 0] / z * camera.fx + camera.cx
        v = local[:, 1] / z * camera.fy + camera.cy
        inside = (local[:, 2] > 0) & (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height)
        shown.append(points[inside])
        depths.append(local[inside, 2])
    all_shown = np.concatenate(shown)
    return (all_shown, np.concatenate(depths)) if len(all_shown) >= _LEAST_POINTS else None


def _from_points(points: Floats, depths: Floats) -> World:
    centre = np.median(points, axis=0)
    nearest = max(float(np.quantile(depths, STRAYS)), 1e-12)
    scale = max(DISTANCE / float(np.median(depths)), NEAREST / nearest)
    spread = np.abs(points - centre).max(axis=1)
    return World(centre, scale, float(np.quantile(spread, 1 - STRAYS)) * scale)


def _from_cameras(views: Sequence[View], depths: tuple[float, float] | None) -> World:
    """Return a world round where the lines of sight meet, or at a middle depth."""
    centres = np.stack([view.camera.centre for view in views])
    ahead = np.stack([view.camera.rotation[2] for view in views])
    focus = _meeting_point(centres, ahead)
    along = np.einsum("vi,vi->v", focus - centres, ahead)
    distance = float(np.median(along))
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    if np.quantile(along, 0.1) <= 0 or distance > 100 * max(spread, 1e-12):
        # parallel, or away from one another: there is no such point
        known = np.sqrt(depths[0] * depths[1]) if depths else 0.0
        distance = max(float(known), spread) or 1.0
        focus = (centres + distance * ahead).mean(axis=0)
    scale = DISTANCE / distance
    reach = float(np.linalg.norm(centres - focus, axis=1).max())
    return World(focus, scale, max(DISTANCE, reach * scale))


def _meeting_point(centres: Floats, directions: Floats) -> Floats:
    """Return the point nearest to all lines, (3,), in the sense of least squares.

    Where the lines are nearly parallel it is pulled towards the mean of the centres.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    mean = centres.mean(axis=0)
    normal = across.sum(axis=0) + 1e-6 * len(centres) * np.eye(3)
    offsets = np.einsum("vij,vj->i", across, centres - mean)
    meeting: Floats = mean + np.linalg.solve(normal, offsets)
    return meeting
