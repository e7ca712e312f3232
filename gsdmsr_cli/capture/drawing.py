"""Draws the camera path and the points as SVG, from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.scene import View

Floats = NDArray[np.float64]

SIDE, MARGIN = 420, 24
"""Of the picture [px]."""

POINTS = 1500
"""At most so many points are drawn, evenly chosen."""

QUANTILE = 0.02
"""Points outside of this share, at each end of each axis, are left out."""

_STYLE = (
    ".seen{fill:#8888}.path{fill:none;stroke:#888;stroke-width:1}"
    ".sight{stroke-width:1.2}.label{font:13px system-ui,sans-serif;fill:currentColor}"
)


def draw_path(views: Sequence[View], points: Floats, axes: tuple[int, int], title: str) -> str:
    """Return an SVG of the cameras, early ones blue and late ones orange, and of the points.

    Args:
        views: in the order of time.
        points: (P, 3) in the world of the views.
        axes: of the world that point right and up in the picture.
        title: what it shows.
    """
    centres = np.stack([view.camera.centre for view in views])
    ahead = np.stack([view.camera.rotation[2] for view in views])
    low, high = _limits(centres, points)
    centre = (low + high)[list(axes)] / 2
    extent = float((high - low)[list(axes)].max()) or 1.0
    scale = (SIDE - 2 * MARGIN) / extent

    def place(position: Floats) -> tuple[float, float]:
        across, up = (position[list(axes)] - centre) * scale
        return SIDE / 2 + across, SIDE / 2 - up

    inside = ((points >= low) & (points <= high)).all(axis=1)
    chosen = points[inside][:: max(1, int(inside.sum()) // POINTS)]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIDE} {SIDE}" role="img"'
        f' aria-label="{title}"><style>{_STYLE}</style>'
    ]
    parts += [
        f'<circle class="seen" cx="{x:.1f}" cy="{y:.1f}" r="0.9"/>' for x, y in map(place, chosen)
    ]
    places = [place(position) for position in centres]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    parts.append(f'<polyline class="path" points="{line}"/>')
    length = 0.05 * extent
    for i, ((x, y), position, direction) in enumerate(zip(places, centres, ahead, strict=True)):
        colour = _colour(i / max(len(views) - 1, 1))
        u, v = place(position + length * direction)
        parts.append(
            f'<path class="sight" stroke="{colour}" d="M{x:.1f},{y:.1f} {u:.1f},{v:.1f}"/>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{colour}"/>'
        )
    parts.append(f'<text class="label" x="8" y="18">{title}</text></svg>')
    return "\n".join(parts)


def _limits(centres: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return the corners of the box that holds all cameras and all but outlying points."""
    low, high = centres.min(axis=0), centres.max(axis=0)
    if len(points):
        low = np.minimum(low, np.quantile(points, QUANTILE, axis=0))
        high = np.maximum(high, np.quantile(points, 1 - QUANTILE, axis=0))
    return low, high


def _colour(share: float) -> str:
    """Return a colour from blue at 0 to orange at 1, both legible on light and dark ground."""
    early, late = np.array([0x1F, 0x77, 0xD0]), np.array([0xE8, 0x7A, 0x1D])
    red, green, blue = np.rint(early + share * (late - early)).astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"
