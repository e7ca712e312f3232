"""Computes with unit quaternions wxyz as rows of arrays, and interpolates rotations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def quaternion(rotation: Floats) -> Floats:
    """Return the (4,) unit quaternion of a (3, 3) rotation, w >= 0.

    The eigenvector of the largest eigenvalue of a symmetric 4x4 matrix (Bar-Itzhack 2000), which
    has no special cases and takes the nearest rotation where the matrix is not quite one.
    """
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    largest = np.linalg.eigh(k)[1][:, -1]
    return np.asarray(-largest if largest[0] < 0 else largest)


def multiply(a: Floats, b: Floats) -> Floats:
    """Return the (N, 4) products: first ``b``, then ``a``."""
    (w, x, y, z), (i, j, k, m) = a.T, b.T
    return np.stack(
        [
            w * i - x * j - y * k - z * m,
            w * j + x * i + y * m - z * k,
            w * k - x * m + y * i + z * j,
            w * m + x * k - y * j + z * i,
        ],
        axis=1,
    )


def exponential(vectors: Floats) -> Floats:
    """Return the (N, 4) quaternions of (N, 3) rotation vectors, axis times angle [rad]."""
    half = np.linalg.norm(vectors, axis=1, keepdims=True) / 2
    # sin(x) / x of numpy's sinc, which has a factor of pi and no hole at 0
    return np.concatenate([np.cos(half), vectors / 2 * np.sinc(half / np.pi)], axis=1)


def logarithm(quats: Floats) -> Floats:
    """Return the (N, 3) rotation vectors of (N, 4) quaternions, each the shorter way [rad]."""
    quats = np.where(quats[:, :1] < 0, -quats, quats)
    length = np.linalg.norm(quats[:, 1:], axis=1, keepdims=True)
    half = np.arctan2(length, quats[:, :1])
    return np.asarray(quats[:, 1:] * 2 / np.sinc(half / np.pi))


def turns(quats: Floats) -> Floats:
    """Return the (K - 1, 3) rotation vectors from each of (K, 4) quaternions to the next."""
    return logarithm(multiply(_inverse(quats[:-1]), quats[1:]))


def slerp(start: Floats, end: Floats, u: Floats) -> Floats:
    """Return the (N, 4) quaternions at ``u``, (N,), of the shorter arcs between two (N, 4)."""
    between = logarithm(multiply(_inverse(start), end))
    return multiply(start, exponential(between * u[:, None]))


def bezier(points: list[Floats], u: Floats) -> Floats:
    """Return the (N, 4) quaternions at ``u``, (N,), of Bezier curves of (N, 4) control points.

    De Casteljau's construction with arcs in place of lines (Shoemake 1985).
    """
    while len(points) > 1:
        points = [slerp(a, b, u) for a, b in pairwise(points)]
    return points[0]


def _inverse(quats: Floats) -> Floats:
    return np.asarray(quats * np.array([1.0, -1.0, -1.0, -1.0]))
