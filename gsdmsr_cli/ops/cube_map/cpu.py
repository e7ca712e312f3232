"""Colours of directions on arrays, a pixel after the other."""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel

_BLOCKS = 16
"""Most parts of a picture whose sums are added in order."""

_ZERO, _HALF, _ONE = float32(0), float32(0.5), float32(1)


@inline
def _way(lines, x, y):
    """Return the direction of a pixel."""
    right, down = float32(x), float32(y)
    return (
        lines[2, 0] + right * lines[0, 0] + down * lines[1, 0],
        lines[2, 1] + right * lines[0, 1] + down * lines[1, 1],
        lines[2, 2] + right * lines[0, 2] + down * lines[1, 2],
    )


@inline
def _face(a, b, c):
    """Return the face that a direction goes through, and where: -1 to 1, twice."""
    p, q, r = abs(a), abs(b), abs(c)
    if p >= q and p >= r:
        return (1 if a > _ZERO else 0), b / p, c / p
    if q >= r:
        return (3 if b > _ZERO else 2), c / q, a / q
    return (5 if c > _ZERO else 4), a / r, b / r


@inline
def _cell(place, size):
    """Return the lower of the two rows or columns around a place, and the weight of the upper."""
    at = min(max((place + _ONE) * _HALF * float32(size - 1), _ZERO), float32(size - 1))
    lower = min(int(at), size - 2)
    return lower, at - float32(lower)


@inline
def _corners(points, lines, x, y):
    """Return the four points around a pixel's direction, and their weights."""
    a, b, c = _way(lines, x, y)
    face, u, v = _face(a, b, c)
    row, s = _cell(u, points.shape[1])
    column, t = _cell(v, points.shape[1])
    return (
        points[face, row, column],
        points[face, row, column + 1],
        points[face, row + 1, column],
        points[face, row + 1, column + 1],
        (_ONE - s) * (_ONE - t),
        (_ONE - s) * t,
        s * (_ONE - t),
        s * t,
    )


@parallel
def show(planes, alpha, colours, points, lines, found):
    """Write what has been drawn with what lies behind it.

    Args:
        planes, alpha: (3, H, W), (H, W) drawn.
        colours, points: (M, 3), (6, n, n).
        lines: (3, 3) ways from a pixel to the next of its row and column, and to the first.
        found: (3, H, W) out.
    """
    for y in prange(alpha.shape[0]):
        for x in range(alpha.shape[1]):
            i, j, k, m, p, q, r, s = _corners(points, lines, x, y)
            through = _ONE - alpha[y, x]
            for c in range(3):
                colour = p * colours[i, c] + q * colours[j, c] + r * colours[k, c]
                found[c, y, x] = planes[c, y, x] + through * (colour + s * colours[m, c])


@parallel
def show_backward(alpha, colours, points, lines, d_found, d_alpha, d_colours):
    """Write the gradients of ``show``; that of what has been drawn is ``d_found`` itself.

    Each part of the rows has sums of its own, as long as these are fewer than the pixels.
    """
    height, width = alpha.shape
    blocks = max(1, min(_BLOCKS, height * width // max(colours.shape[0], 1)))
    sums = np.zeros((blocks, colours.shape[0], 3), np.float32)
    for block in prange(blocks):
        for y in range(height * block // blocks, height * (block + 1) // blocks):
            for x in range(width):
                i, j, k, m, p, q, r, s = _corners(points, lines, x, y)
                through, total = _ONE - alpha[y, x], _ZERO
                for c in range(3):
                    given = d_found[c, y, x]
                    colour = p * colours[i, c] + q * colours[j, c] + r * colours[k, c]
                    total -= given * (colour + s * colours[m, c])
                    given *= through
                    sums[block, i, c] += p * given
                    sums[block, j, c] += q * given
                    sums[block, k, c] += r * given
                    sums[block, m, c] += s * given
                d_alpha[y, x] = total
    for row in prange(colours.shape[0]):
        for c in range(3):
            total = _ZERO
            for block in range(blocks):
                total += sums[block, row, c]
            d_colours[row, c] = total
