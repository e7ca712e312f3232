"""Finds the nearest of few points for each of many: by a guess, then in boxes of 16."""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel

_LANES = simd.LANES
_BLOCKS = 16
_BATCH = 64
"""Boxes that are looked at together: bits of an integer tell which of them are near enough."""
_ZERO = float32(0)
_FAR = float32(1e18)
_INFINITE = float32(np.inf)
_SLACK = float32(1.0001)
"""A distance that is worked out anew may round otherwise than a bound on it."""


@inline
def _group(nodes, flat, corners, boxes):
    """Lay nodes out by axis and write the boxes of every 16 in a row, also by axis."""
    for g in range((nodes.shape[0] + _LANES - 1) // _LANES):
        for axis in range(3):
            low, high = _FAR, -_FAR
            for j in range(g * _LANES, min(nodes.shape[0], (g + 1) * _LANES)):
                flat[axis * boxes * _LANES + j] = nodes[j, axis]
                low, high = min(low, nodes[j, axis]), max(high, nodes[j, axis])
            corners[axis * boxes + g] = low
            corners[(3 + axis) * boxes + g] = high


@inline
def _outside(x, corners, boxes, axis, at):
    """Return how far x is from 16 boxes along an axis, 0 where it is within."""
    low, high = simd.load(corners, axis * boxes + at), simd.load(corners, (3 + axis) * boxes + at)
    return x - simd.minimum(simd.maximum(x, low), high)


@inline
def _boxes_within(x, y, z, corners, boxes, at, bound):
    """Return which of 64 boxes have places within a squared distance, as the bits of an integer."""
    within = 0
    for o in range(0, _BATCH, _LANES):
        a = _outside(x, corners, boxes, 0, at + o)
        b = _outside(y, corners, boxes, 1, at + o)
        c = _outside(z, corners, boxes, 2, at + o)
        within |= simd.lanes_le(a * a + b * b + c * c, bound) << o
    return within


@inline
def _square(points, i, nodes, j):
    """Return the squared distance of a point to a node."""
    x, y, z = points[i, 0] - nodes[j, 0], points[i, 1] - nodes[j, 1], points[i, 2] - nodes[j, 2]
    return x * x + y * y + z * z


@inline
def _bound(points, i, nodes, near):
    """Return a squared distance that the guessed nodes lie within, infinite if they are no guess.

    Guesses are rows in ascending order.
    """
    kept, bound = near.shape[1], _ZERO
    for k in range(kept):
        j = near[i, k]
        if k > 0 and j <= near[i, k - 1]:
            return _INFINITE
        bound = max(bound, _square(points, i, nodes, j))
    return bound * _SLACK + float32(1e-30)


@inline
def _distances(x, y, z, flat, boxes, g):
    """Return the squared distances to the 16 nodes of a box."""
    a = simd.load(flat, g * _LANES) - x
    b = simd.load(flat, (boxes + g) * _LANES) - y
    c = simd.load(flat, (2 * boxes + g) * _LANES) - z
    return a * a + b * b + c * c


@inline
def _nodes_within(x, y, z, flat, corners, boxes, bound):
    """Return how many nodes lie within a squared distance."""
    count, limit = 0, simd.splat(bound)
    for first in range(0, boxes, _BATCH):
        rest = _boxes_within(x, y, z, corners, boxes, first, limit)
        while rest != 0:
            g = first + simd.lowest_bit(rest)
            count += simd.count_bits(simd.lanes_le(_distances(x, y, z, flat, boxes, g), limit))
            rest &= rest - 1
    return count


@inline
def _insert(near, i, best, row, distance):
    """Put a node where it belongs among the nearest so far, if it does; ``best`` ascends."""
    k = near.shape[1]
    while k > 0 and best[k - 1] > distance:
        if k < near.shape[1]:
            best[k], near[i, k] = best[k - 1], near[i, k - 1]
        k -= 1
    if k < near.shape[1]:
        best[k], near[i, k] = distance, row


@inline
def _search(x, y, z, flat, corners, boxes, count, bound, near, i, best, distances):
    """Write the nearest of ``count`` nodes, all of which lie within a squared distance."""
    best[:], limit = bound, simd.splat(bound)
    for first in range(0, boxes, _BATCH):
        rest = _boxes_within(x, y, z, corners, boxes, first, limit)
        while rest != 0:
            g = first + simd.lowest_bit(rest)
            found = _distances(x, y, z, flat, boxes, g)
            simd.store(distances, 0, found)
            lanes = simd.lanes_le(found, limit)
            while lanes != 0:
                lane = simd.lowest_bit(lanes)
                if g * _LANES + lane < count:
                    _insert(near, i, best, g * _LANES + lane, distances[lane])
                lanes &= lanes - 1
            limit = simd.splat(best[near.shape[1] - 1])
            rest &= rest - 1


@inline
def _sort(rows, i):
    """Put a row's values into ascending order."""
    for k in range(1, rows.shape[1]):
        value, at = rows[i, k], k
        while at > 0 and rows[i, at - 1] > value:
            rows[i, at] = rows[i, at - 1]
            at -= 1
        rows[i, at] = value


@parallel
def nearest(points, nodes, near):
    """Find the nearest nodes of each point, exactly.

    Guesses mostly prove right: then no other node lies within their distance. Where others do, the
    nearest are searched for. Only nodes in boxes that are near enough are looked at.

    Args:
        points: (N, 3).
        nodes: (M, 3); it is quick where those that follow each other lie near each other.
        near: (N, K) int32, K at most M; in: guesses, an earlier result or zeros; out: the rows of
            the nearest, in ascending order; of equally near ones the first.
    """
    (n, kept), count = near.shape, nodes.shape[0]
    boxes = (count + _BATCH * _LANES - 1) // (_BATCH * _LANES) * _BATCH
    flat, corners = np.full(3 * boxes * _LANES, _FAR), np.full(6 * boxes, _FAR)
    _group(nodes, flat, corners, boxes)
    for block in prange(_BLOCKS):
        best, distances = np.empty(kept, np.float32), np.empty(_LANES, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            x, y, z = simd.splat(points[i, 0]), simd.splat(points[i, 1]), simd.splat(points[i, 2])
            bound = _bound(points, i, nodes, near)
            if bound < _INFINITE and _nodes_within(x, y, z, flat, corners, boxes, bound) == kept:
                continue
            _search(x, y, z, flat, corners, boxes, count, bound, near, i, best, distances)
            _sort(near, i)
