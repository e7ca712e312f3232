"""Finds the nearest of few points for each of many queries, again and again while both move.

Where neither can have moved far enough to change it, the earlier result stands. Elsewhere it is a
guess, which the points within its distance confirm. Else the nearest are searched for, in boxes of
16 points.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel

_LANES = simd.LANES
_BLOCKS = 16
_BATCH = 64
"""Boxes that are looked at together: bits of an integer tell which of them are near enough."""
_ZERO, _HALF, _ONE = float32(0), float32(0.5), float32(1)
_FAR = float32(1e18)
_INFINITE = float32(np.inf)
_SLACK = float32(1.0001)
"""A distance that is worked out anew may round otherwise than a bound on it."""
_BEYOND = float32(1.2)
"""The nearest of the other points is looked for within so many times the squared bound."""
_ROUNDED = 1 - 1e-6
"""Sums of lengths count as so much shorter: rounding may have made them longer."""


@inline
def _group(points, flat, corners, boxes):
    """Lay points out by axis and write the boxes of every 16 in a row, also by axis."""
    for g in range((points.shape[0] + _LANES - 1) // _LANES):
        for axis in range(3):
            low, high = _FAR, -_FAR
            for j in range(g * _LANES, min(points.shape[0], (g + 1) * _LANES)):
                flat[axis * boxes * _LANES + j] = points[j, axis]
                low, high = min(low, points[j, axis]), max(high, points[j, axis])
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
def _square(queries, i, points, j):
    """Return the squared distance of a query to a point."""
    x, y, z = (
        queries[i, 0] - points[j, 0],
        queries[i, 1] - points[j, 1],
        queries[i, 2] - points[j, 2],
    )
    return x * x + y * y + z * z


@inline
def _bound(queries, i, points, near):
    """Return a squared distance that the guessed points lie within, infinite if they are no guess.

    Guesses are rows in ascending order.
    """
    kept, bound = near.shape[1], _ZERO
    for k in range(kept):
        j = near[i, k]
        if k > 0 and j <= near[i, k - 1]:
            return _INFINITE
        bound = max(bound, _square(queries, i, points, j))
    return bound * _SLACK + float32(1e-30)


@inline
def _distances(x, y, z, flat, boxes, g):
    """Return the squared distances to the 16 points of a box."""
    a = simd.load(flat, g * _LANES) - x
    b = simd.load(flat, (boxes + g) * _LANES) - y
    c = simd.load(flat, (2 * boxes + g) * _LANES) - z
    return a * a + b * b + c * c


@inline
def _room(x, y, z, flat, corners, boxes, bound, kept):
    """Return how far a query and all points may go, added up, before another point can be nearer.

    That is half of how much farther the nearest of the others is than those within a squared
    distance; -1 if the points within it are not as many as are kept.
    """
    count, limit, reach = 0, simd.splat(bound), simd.splat(_BEYOND * bound)
    others, far = reach, simd.splat(_FAR)
    for first in range(0, boxes, _BATCH):
        rest = _boxes_within(x, y, z, corners, boxes, first, reach)
        while rest != 0:
            found = _distances(x, y, z, flat, boxes, first + simd.lowest_bit(rest))
            count += simd.count_bits(simd.lanes_le(found, limit))
            others = simd.minimum(others, found + simd.where_ge(limit, found, far))
            rest &= rest - 1
    if count != kept:
        return -_ONE
    nearest_other = -simd.reduce_max(simd.splat(_ZERO) - others)
    return _HALF * (math.sqrt(nearest_other) - math.sqrt(bound))


@inline
def _insert(near, i, best, row, distance):
    """Put a point where it belongs among the nearest so far, if it does; ``best`` ascends."""
    k = near.shape[1]
    while k > 0 and best[k - 1] > distance:
        if k < near.shape[1]:
            best[k], near[i, k] = best[k - 1], near[i, k - 1]
        k -= 1
    if k < near.shape[1]:
        best[k], near[i, k] = distance, row


@inline
def _search(x, y, z, flat, corners, boxes, count, bound, near, i, best, distances):
    """Write the nearest of ``count`` points, all of which lie within a squared distance."""
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


@inline
def _drift(points, before):
    """Return how far any point has gone from where it was, and put down where it is."""
    farthest, total = _ZERO, _ZERO
    for j in range(points.shape[0]):
        square = _square(points, j, before, j)
        farthest, total = max(farthest, square), total + square
        for axis in range(3):
            before[j, axis] = points[j, axis]
    return _SLACK * math.sqrt(farthest) if total < _INFINITE else _INFINITE


@inline
def _stands(queries, i, places, until, gone):
    """Return whether a query and the points are too near to where they were for another result."""
    room = float32(until[i] - gone)
    return room > _ZERO and _square(queries, i, places, i) < room * room


@parallel
def nearest(queries, points, near, places, until, before, drift):
    """Find the nearest points of each query, exactly.

    What an earlier call has found may be given to the next, whatever has changed meanwhile.

    Args:
        queries: (N, 3).
        points: (M, 3); it is quick where those that follow each other lie near each other.
        near: (N, K) int32, K at most M; in: guesses, an earlier result or zeros; out: the rows of
            the nearest, in ascending order; of equally near ones the first.
        places: (N, 3), where queries were when ``near`` was confirmed; in and out.
        until: (N,), by how much ``drift`` and the way of a query from its place may add up before
            the result can change, zeros at first; in and out.
        before: (M, 3), where the points were in the call before; in and out.
        drift: (1,) float64, how far any point may have gone in all calls, 0 at first; in and out.
    """
    (n, kept), count = near.shape, points.shape[0]
    boxes = (count + _BATCH * _LANES - 1) // (_BATCH * _LANES) * _BATCH
    flat, corners = np.full(3 * boxes * _LANES, _FAR), np.full(6 * boxes, _FAR)
    _group(points, flat, corners, boxes)
    gone = drift[0] + _drift(points, before)
    drift[0] = gone
    for block in prange(_BLOCKS):
        best, distances = np.empty(kept, np.float32), np.empty(_LANES, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            if _stands(queries, i, places, until, gone):
                continue
            x, y = simd.splat(queries[i, 0]), simd.splat(queries[i, 1])
            z = simd.splat(queries[i, 2])
            bound, room = _bound(queries, i, points, near), -_ONE
            if bound < _INFINITE:
                room = _room(x, y, z, flat, corners, boxes, bound, kept)
            if room < _ZERO:
                _search(x, y, z, flat, corners, boxes, count, bound, near, i, best, distances)
                _sort(near, i)
            until[i] = (gone + room) * _ROUNDED
            for axis in range(3):
                places[i, axis] = queries[i, axis]
