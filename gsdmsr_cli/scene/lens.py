"""Lenses that bend straight lines, and the pinhole cameras that stand in for them.

Pictures taken through a lens are undistorted while they are decoded; nothing after that knows of
it. Both models are OpenCV's: Brown's, with the rational terms of its calib3d, and the fisheye of
Kannala and Brandt (2006).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.camera import Camera

Floats = NDArray[np.float64]

WIDEST, NARROWEST = 0.7, 8.0
"""Bounds of the pinhole's focal length, in units of the lens's.

A fisheye may record more than a pinhole can show; seeing ever more of it would cost ever more of
the resolution in the middle.
"""

_GRID = 41
"""Points along each side of a picture at which a pinhole is tried."""

_HALVINGS = 40


@dataclass(frozen=True)
class Lens:
    """How a direction becomes a pixel of the picture as it was recorded.

    Attributes:
        fx, fy: focal lengths [px].
        cx, cy: principal point [px]; the centre of a W x H picture is (W / 2, H / 2).
        width, height: size of the recorded picture [px].
        radial: Brown's k1, k2, k3 and, as divisors, k4, k5, k6; or the fisheye's k1 to k4. Those
            left out are 0.
        tangential: Brown's p1, p2.
        skew: pixels to the right per unit of y.
        fisheye: whether the radial terms are of the angle rather than of its tangent.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    radial: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    skew: float = 0.0
    fisheye: bool = False

    def __post_init__(self) -> None:
        most = 4 if self.fisheye else 6
        if len(self.radial) > most:
            raise ValueError(f"{len(self.radial)} radial terms; this model has {most}")
        if self.fisheye and any(self.tangential):
            raise ValueError("the fisheye model has no tangential terms")

    @property
    def is_pinhole(self) -> bool:
        """Whether its pictures are those of a pinhole as they are."""
        return not (self.fisheye or self.skew or any(self.radial) or any(self.tangential))

    def resized(self, width: int, height: int) -> Lens:
        """Return the lens of the same picture resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            skew=self.skew * sx,
            width=width,
            height=height,
        )

    def project(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the pixels that directions (x, y, 1) in camera axes fall on; any shape."""
        bent_x, bent_y = self._bend_fisheye(x, y) if self.fisheye else self._bend(x, y)
        return self.fx * bent_x + self.skew * bent_y + self.cx, self.fy * bent_y + self.cy

    def _bend(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        k1, k2, k3, k4, k5, k6 = (*self.radial, *[0.0] * (6 - len(self.radial)))
        p1, p2 = self.tangential
        r2 = x * x + y * y
        factor = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        bent_x = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * factor + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        return bent_x, bent_y

    def _bend_fisheye(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        k1, k2, k3, k4 = (*self.radial, *[0.0] * (4 - len(self.radial)))
        radius = np.hypot(x, y)
        angle = np.arctan(radius)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        factor = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 1e-12)
        return x * factor, y * factor

    def camera(self, world_to_camera: Floats) -> Camera:
        """Return the pinhole whose pictures replace the recorded ones, of the same size.

        It has the lens's principal point and proportions, and sees as much as it can without
        showing anything that was not recorded, within ``WIDEST``.
        """
        zoom = 1.0 if self.is_pinhole else _zoom(self)
        return Camera(
            world_to_camera, self.fx * zoom, self.fy * zoom, self.cx, self.cy,
            self.width, self.height,
        )  # fmt: skip

    def sources(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return where each pixel of the pinhole's picture lies in the recorded one.

        Two (H, W) arrays of columns and rows, counted from the centre of the first pixel.
        """
        rows, columns = np.mgrid[: self.height, : self.width] + 0.5
        u, v = self._seen(columns, rows, _zoom(self))
        return (u - 0.5).astype(np.float32), (v - 0.5).astype(np.float32)

    def _seen(self, columns: Floats, rows: Floats, zoom: float) -> tuple[Floats, Floats]:
        """Return the recorded pixels that a pinhole shows, whose focal length is ``zoom`` times."""
        x, y = (columns - self.cx) / (self.fx * zoom), (rows - self.cy) / (self.fy * zoom)
        return self.project(x, y)


@lru_cache(maxsize=64)
def _zoom(lens: Lens) -> float:
    """Return the least zoom at which a pinhole shows nothing but what was recorded, by halving."""
    low, high = WIDEST, 1.0
    while not _shows_recorded(lens, high) and high < NARROWEST:
        low, high = high, 2 * high
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if _shows_recorded(lens, middle) else (middle, high)
    return high


def _shows_recorded(lens: Lens, zoom: float) -> bool:
    """Return whether all of the pinhole's picture lies in the recorded one, without folds.

    Polynomials turn back far outside of the picture, where they would show a mirror image.
    """
    columns, rows = np.meshgrid(
        np.linspace(0, lens.width, _GRID), np.linspace(0, lens.height, _GRID)
    )
    u, v = lens._seen(columns, rows, zoom)
    inside = (u >= 0) & (u <= lens.width) & (v >= 0) & (v <= lens.height)
    du, dv = np.diff(u, axis=1)[:-1], np.diff(v, axis=1)[:-1]
    down_u, down_v = np.diff(u, axis=0)[:, :-1], np.diff(v, axis=0)[:, :-1]
    return bool(inside.all() and (du * down_v - dv * down_u > 0).all())
