"""Looks features up in hash grids and scatters gradients back, on arrays (Mueller et al. 2022).

The number of axes is the length of a tuple of factors, so that it is known when kernels are
compiled and loops over the corners of a cell are unrolled.
"""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel

_BLOCKS = 64
_HALF = float32(0.5)
_ONE = float32(1)


@inline
def _find_cell(points, i, sizes, level, lower, upper):
    """Write the lower grid point and the weight of the upper one along each axis.

    What is not a number is taken for -1, as the kernels of plane grids do.
    """
    for axis in range(sizes.shape[1]):
        size = sizes[level, axis]
        u, last = (points[i, axis] + _ONE) * _HALF * float32(size - 1), float32(size - 1)
        u = u if u > float32(0) else float32(0)
        u = u if u < last else last
        lower[axis] = min(int(u), size - 2)
        upper[axis] = u - float32(lower[axis])


@inline
def _find_rows(sizes, level, offsets, factors, lower, rows):
    """Write the row of the table that holds each of the 2^d corners of a cell."""
    first, many = offsets[level], offsets[level + 1] - offsets[level]
    points = 1
    for axis in range(len(factors)):
        points *= sizes[level, axis]
    if points > many:
        for corner in range(1 << len(factors)):
            row = 0
            for axis in range(len(factors)):
                row ^= (lower[axis] + (corner >> axis & 1)) * factors[axis]
            rows[corner] = first + (row & (many - 1))
    else:
        for corner in range(1 << len(factors)):
            row, stride = first, 1
            for axis in range(len(factors)):
                row += (lower[axis] + (corner >> axis & 1)) * stride
                stride *= sizes[level, axis]
            rows[corner] = row


@inline
def _weigh(factors, upper, weights):
    """Write the weight of each corner of a cell."""
    for corner in range(1 << len(factors)):
        weight = _ONE
        for axis in range(len(factors)):
            weight *= upper[axis] if corner >> axis & 1 else _ONE - upper[axis]
        weights[corner] = weight


@inline
def _slope(factors, upper, values, axis):
    """Return the derivative along an axis, in cells, of what has ``values`` at the corners."""
    total = float32(0)
    for corner in range(1 << len(factors)):
        weight = _ONE
        for other in range(len(factors)):
            if other != axis:
                weight *= upper[other] if corner >> other & 1 else _ONE - upper[other]
        total += weight * values[corner] if corner >> axis & 1 else -weight * values[corner]
    return total


@parallel
def lookup(points, table, sizes, offsets, factors, features):
    """Write the (N, L F) features of (N, d) points.

    Args:
        points: in [-1, 1], others are clamped.
        table: (rows, F) values of all levels.
        sizes: (L, d) int64 grid points.
        offsets: (L + 1,) int64 first row of each level.
        factors: of the hash, a tuple of d whole numbers.
        features: out, the levels side by side; columns beyond theirs are left as they are.
    """
    n, width, corners = points.shape[0], table.shape[1], 1 << len(factors)
    for block in prange(_BLOCKS):
        lower, upper = np.empty(len(factors), np.int64), np.empty(len(factors), np.float32)
        rows, weights = np.empty(corners, np.int64), np.empty(corners, np.float32)
        for level in range(sizes.shape[0]):
            for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
                _find_cell(points, i, sizes, level, lower, upper)
                _find_rows(sizes, level, offsets, factors, lower, rows)
                _weigh(factors, upper, weights)
                for k in range(width):
                    total = float32(0)
                    for corner in range(corners):
                        total += weights[corner] * table[rows[corner], k]
                    features[i, level * width + k] = total


@parallel
def lookup_backward(points, table, sizes, offsets, factors, d_features, d_table, shares, d_points):
    """Write the gradients of the table and, if wanted, of the points.

    Every thread owns whole levels, so that threads never write to one place and the sums do not
    depend on their number. Points outside [-1, 1] get no gradient along that axis.

    Args:
        points, table, sizes, offsets, factors: see ``lookup``.
        d_features: (N, L F or more).
        d_table: out, like ``table``.
        shares: (L, N, d) room for what each level adds to ``d_points``.
        d_points: (N, d) out, or (0, d) if not wanted.
    """
    n, width, corners = points.shape[0], table.shape[1], 1 << len(factors)
    wanted = d_points.shape[0] > 0
    for level in prange(sizes.shape[0]):
        lower, upper = np.empty(len(factors), np.int64), np.empty(len(factors), np.float32)
        rows, weights = np.empty(corners, np.int64), np.empty(corners, np.float32)
        d_table[offsets[level] : offsets[level + 1]] = float32(0)
        for i in range(n):
            live = False
            for k in range(width):
                live = live or d_features[i, level * width + k] != float32(0)
            if wanted:
                shares[level, i] = float32(0)
            if not live:
                continue
            _find_cell(points, i, sizes, level, lower, upper)
            _find_rows(sizes, level, offsets, factors, lower, rows)
            _weigh(factors, upper, weights)
            for k in range(width):
                d = d_features[i, level * width + k]
                for corner in range(corners):
                    d_table[rows[corner], k] += weights[corner] * d
            if wanted:
                for corner in range(corners):
                    total = float32(0)
                    for k in range(width):
                        total += d_features[i, level * width + k] * table[rows[corner], k]
                    weights[corner] = total
                for axis in range(len(factors)):
                    if abs(points[i, axis]) <= _ONE:
                        cells = _HALF * float32(sizes[level, axis] - 1)
                        shares[level, i, axis] = cells * _slope(factors, upper, weights, axis)
    for block in prange(_BLOCKS):
        for i in range(
            d_points.shape[0] * block // _BLOCKS, d_points.shape[0] * (block + 1) // _BLOCKS
        ):
            for axis in range(len(factors)):
                total = float32(0)
                for level in range(sizes.shape[0]):
                    total += shares[level, i, axis]
                d_points[i, axis] = total
