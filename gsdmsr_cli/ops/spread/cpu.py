"""Chooses points that are far from each other: farthest-point sampling (Gonzalez 1985)."""

from __future__ import annotations

import numpy as np

from gsdmsr_cli.backends.cpu.jit import inline, serial

_BUCKET = 16
"""Points in a row that are passed over together."""


@inline
def _outside(x, low, high):
    """Return how far x lies outside an interval."""
    return max(low - x, x - high, 0.0)


@inline
def _shorten(points, squares, away, low, high, x, y, z):
    """Let points know of a chosen one at (x, y, z); return the longest distance that is left."""
    longest = 0.0
    for i in range(low, high):
        a, b, c = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
        away[i] = min(away[i], squares[i] * (a * a + b * b + c * c))
        longest = max(longest, away[i])
    return longest


@serial
def choose_spread(points, squares, first, rows):
    """Write the rows of points that are far from each other.

    Each is the farthest from those before it, of equally far ones the first. What it costs is far
    below N times the number of rows: a chosen point shortens the distances of those near it alone,
    and 16 points in a row are passed over where none of them can be.

    Args:
        points: (N, 3) float64, finite, N at least 1; it is quick where points that follow each
            other lie near each other.
        squares: (N,) float64, by what the square of each one's distance is multiplied, above 0:
            points are chosen the nearer to each other the more it is.
        first: which point to begin with.
        rows: (M,) int64, out; rows repeat where there are fewer places than M.
    """
    n = points.shape[0]
    buckets = (n + _BUCKET - 1) // _BUCKET
    away, longest = np.full(n, np.inf), np.full(buckets, np.inf)
    lower, upper = np.full((buckets, 3), np.inf), np.full((buckets, 3), -np.inf)
    least = np.full(buckets, np.inf)
    for i in range(n):
        least[i // _BUCKET] = min(least[i // _BUCKET], squares[i])
        for axis in range(3):
            lower[i // _BUCKET, axis] = min(lower[i // _BUCKET, axis], points[i, axis])
            upper[i // _BUCKET, axis] = max(upper[i // _BUCKET, axis], points[i, axis])
    chosen = first
    for m in range(rows.shape[0]):
        rows[m] = chosen
        x, y, z, farthest = points[chosen, 0], points[chosen, 1], points[chosen, 2], 0
        for b in range(buckets):
            a = _outside(x, lower[b, 0], upper[b, 0])
            c = _outside(y, lower[b, 1], upper[b, 1])
            d = _outside(z, lower[b, 2], upper[b, 2])
            if least[b] * (a * a + c * c + d * d) < longest[b]:
                last = min(n, (b + 1) * _BUCKET)
                longest[b] = _shorten(points, squares, away, b * _BUCKET, last, x, y, z)
            if longest[b] > longest[farthest]:
                farthest = b
        chosen = farthest * _BUCKET
        while away[chosen] != longest[farthest]:
            chosen += 1
