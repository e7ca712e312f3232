"""Textured convex solids for ray tracing, each in its own axes; vectors are columns of (3, R)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_AHEAD = 1e-4  # an entry nearer than this [world units] is the surface that the ray starts on


def column(*values: float) -> Floats:
    """Return the values as one (V, 1) column."""
    return np.array(values, np.float32)[:, None]


def dot(first: Floats, second: Floats) -> Floats:
    """Return the (R,) dot products of the columns of two (3, R); either may be (3, 1)."""
    products: Floats = first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
    return products


_FACE_COLOURS = np.array(
    [[0.15, 0.20, 0.95], [0.45, 0.65, 0.75], [0.85, 0.40, 0.20]], np.float32
)  # (rgb, axis)


class Solid(Protocol):
    """A convex shape about its own origin."""

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere [world units]."""

    def intersect(self, origins: Floats, directions: Floats) -> Floats:
        """Return where (3, R) rays of unit direction enter, (R,); inf where they miss.

        Either argument may be (3, 1).
        """

    def normals(self, points: Floats) -> Floats:
        """Return the (3, R) outward unit normals at points of the surface."""

    def colours(self, points: Floats) -> Floats:
        """Return the (3, R) colours in [0, 1] at points of the surface."""


@dataclass(frozen=True)
class Disc:
    """A flat round ground, seen from above, with a checkered texture."""

    radius: float

    def intersect(self, origins: Floats, directions: Floats) -> Floats:
        """See Solid."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distances = -origins[2] / directions[2]
            points = origins[:2] + distances * directions[:2]
        inside = points[0] ** 2 + points[1] ** 2 < self.radius**2
        return _ahead(distances, inside)

    def normals(self, points: Floats) -> Floats:
        """See Solid."""
        return np.broadcast_to(column(0, 0, 1), points.shape)

    def colours(self, points: Floats) -> Floats:
        """See Solid."""
        dark = (np.floor(points[0] / 0.4) + np.floor(points[1] / 0.4)) % 2 > 0
        return _two_tone(dark, (0.30, 0.36, 0.42), (0.85, 0.82, 0.74))


@dataclass(frozen=True)
class Ball:
    """A sphere with stripes of latitude."""

    radius: float

    def intersect(self, origins: Floats, directions: Floats) -> Floats:
        """See Solid."""
        return _enter_sphere(origins, directions, self.radius)

    def normals(self, points: Floats) -> Floats:
        """See Solid."""
        return points / np.float32(self.radius)

    def colours(self, points: Floats) -> Floats:
        """See Solid."""
        stripe = np.floor((points[2] / self.radius + 1) * 2.5) % 2 > 0
        return _two_tone(stripe, (0.98, 0.92, 0.75), (0.85, 0.22, 0.15))


@dataclass(frozen=True)
class Box:
    """A box with a checkered texture and a colour of its own on every pair of faces.

    Attributes:
        half: half edges [world units].
    """

    half: tuple[float, float, float]

    @property
    def radius(self) -> float:
        """See Solid."""
        return math.hypot(*self.half)

    def intersect(self, origins: Floats, directions: Floats) -> Floats:
        """See Solid; the ray is inside where it is between all three pairs of faces."""
        half = column(*self.half)
        with np.errstate(divide="ignore", invalid="ignore"):
            first, second = (-half - origins) / directions, (half - origins) / directions
        entry = np.minimum(first, second).max(0)
        leave = np.maximum(first, second).min(0)
        return _ahead(entry, entry < leave)

    def _faces(self, points: Floats) -> NDArray[np.intp]:
        """Return the (R,) axis of the face that each point lies on."""
        faces: NDArray[np.intp] = np.abs(points / column(*self.half)).argmax(0)
        return faces

    def normals(self, points: Floats) -> Floats:
        """See Solid."""
        on_face = np.arange(3)[:, None] == self._faces(points)
        return np.where(on_face, np.sign(points), np.float32(0))

    def colours(self, points: Floats) -> Floats:
        """See Solid."""
        cells = np.floor(points / np.float32(0.15) + np.float32(0.5))
        on_face = np.arange(3)[:, None] == self._faces(points)
        dark = np.where(on_face, 0, cells).sum(0) % 2 > 0
        plain = _FACE_COLOURS[:, self._faces(points)]
        shaded: Floats = np.where(dark, plain * np.float32(0.45), plain)
        return shaded


@dataclass(frozen=True)
class Capsule:
    """A round rod along its z axis with a band that winds about it.

    Attributes:
        half: half distance between the centres of its round ends [world units].
        thickness: radius of the rod [world units].
    """

    half: float
    thickness: float

    @property
    def radius(self) -> float:
        """See Solid."""
        return self.half + self.thickness

    def intersect(self, origins: Floats, directions: Floats) -> Floats:
        """See Solid; the first of the entries into the open cylinder and the two end spheres."""
        a = directions[0] ** 2 + directions[1] ** 2
        b = origins[0] * directions[0] + origins[1] * directions[1]
        c = origins[0] ** 2 + origins[1] ** 2 - np.float32(self.thickness**2)
        with np.errstate(divide="ignore", invalid="ignore"):
            side = (-b - np.sqrt(b * b - a * c)) / a
            beside = np.abs(origins[2] + side * directions[2]) <= self.half
        found = _ahead(side, beside)
        for end in (-self.half, self.half):
            cap = _enter_sphere(origins - column(0, 0, end), directions, self.thickness)
            found = np.minimum(found, cap)
        return found

    def normals(self, points: Floats) -> Floats:
        """See Solid."""
        outward = points.copy()
        outward[2] -= points[2].clip(-self.half, self.half)
        return outward / np.float32(self.thickness)

    def colours(self, points: Floats) -> Floats:
        """See Solid."""
        turn = np.arctan2(points[1], points[0]) / (2 * math.pi) + points[2] / 0.3
        return _two_tone(turn % 1 < 0.5, (0.55, 0.25, 0.65), (0.70, 0.85, 0.90))


def _enter_sphere(origins: Floats, directions: Floats, radius: float) -> Floats:
    along = dot(origins, directions)
    discriminant = along * along - dot(origins, origins) + np.float32(radius**2)
    root = np.sqrt(discriminant.clip(min=0))
    return _ahead(-along - root, discriminant > 0)


def _ahead(distances: Floats, hit: NDArray[np.bool_]) -> Floats:
    """Return the distances where the ray hits in front of its start, else inf."""
    found: Floats = np.where(hit & (distances > _AHEAD), distances, np.float32(np.inf))
    return found


def _two_tone(
    mask: NDArray[np.bool_], one: tuple[float, float, float], other: tuple[float, float, float]
) -> Floats:
    """Return (3, R) colours: ``one`` where the mask holds, ``other`` elsewhere."""
    return np.where(mask, column(*one), column(*other))
