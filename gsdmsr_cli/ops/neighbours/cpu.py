"""The nearest neighbours of points, exactly, by a k-d tree (Bentley 1975; Friedman et al. 1977)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from gsdmsr_cli.backends.cpu.jit import inline, parallel

LEAF = 16
"""Most points in a leaf."""

CHUNK = 512
"""Slots that one task looks after; neighbours in the tree share what is in the cache."""


class _Tree(NamedTuple):
    """A balanced tree: node i has the children 2 i + 1 and 2 i + 2, leaves come last, in order.

    Attributes:
        slots: (leaves * LEAF,) rows of the points, leaf by leaf; those that are free hold N.
        lower, upper: (nodes, 3) corners of the box of each node's points.
    """

    slots: NDArray[np.int64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


def mean_squares(points: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Return the mean squared distance of each point to its ``count`` nearest others, (N,).

    Args:
        points: (N, 3), finite; N above ``count``.
        count: 1 or more.
    """
    tree = _build(points)
    found = np.empty(len(points))
    _search(np.ascontiguousarray(points), tree.slots, tree.lower, tree.upper, count, found)
    return found


def near_order(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the rows of points (N, 3), (N,), in an order that keeps neighbours together."""
    slots = _build(points).slots
    return slots[slots < len(points)]


def _build(points: NDArray[np.float64]) -> _Tree:
    """Halve all nodes of a level at once, across the axis along which each is longest."""
    levels = max(0, int(np.ceil(np.log2(len(points) / LEAF))))
    slots = np.full(LEAF << levels, len(points))
    slots[: len(points)] = np.arange(len(points))
    nowhere = np.full((1, 3), np.nan)
    padded = np.concatenate([points, nowhere])  # NaN sorts behind all points
    lower, upper = [], []
    for level in range(levels + 1):
        nodes = slots.reshape(1 << level, -1)
        held = padded[nodes]
        lower.append(np.fmin.reduce(held, axis=1, initial=np.inf))
        upper.append(np.fmax.reduce(held, axis=1, initial=-np.inf))
        if level < levels:
            axis = np.argmax(upper[-1] - lower[-1], axis=1)
            along = np.take_along_axis(held, axis[:, None, None], axis=2)[..., 0]
            order = np.argpartition(along, nodes.shape[1] // 2, axis=1)
            slots = np.take_along_axis(nodes, order, axis=1).reshape(-1)
    return _Tree(slots, np.concatenate(lower), np.concatenate(upper))


@inline
def _distance(points, i, j):
    """Return the squared distance of two points."""
    x, y, z = (
        points[i, 0] - points[j, 0],
        points[i, 1] - points[j, 1],
        points[i, 2] - points[j, 2],
    )
    return x * x + y * y + z * z


@inline
def _box_distance(points, i, lower, upper, node):
    """Return the squared distance of a point to a node's box, infinite if that is empty."""
    total = 0.0
    for axis in range(3):
        below, above = lower[node, axis] - points[i, axis], points[i, axis] - upper[node, axis]
        outside = max(below, above, 0.0)
        total += outside * outside
    return total


@inline
def _insert(best, count, value):
    """Keep the ``count`` smallest values, ascending."""
    if value < best[count - 1]:
        k = count - 1
        while k > 0 and best[k - 1] > value:
            best[k] = best[k - 1]
            k -= 1
        best[k] = value


@parallel
def _search(points, slots, lower, upper, count, found):
    """Write the mean squared distance of each point to its nearest others."""
    first_leaf, none = lower.shape[0] // 2, points.shape[0]
    for task in prange((slots.shape[0] + CHUNK - 1) // CHUNK):
        best = np.empty(count)
        stack = np.empty(64, np.int64)
        for slot in range(task * CHUNK, min((task + 1) * CHUNK, slots.shape[0])):
            i = slots[slot]
            if i == none:
                continue
            best[:] = np.inf
            stack[0], depth = 0, 1
            while depth > 0:
                depth -= 1
                node = stack[depth]
                if _box_distance(points, i, lower, upper, node) >= best[count - 1]:
                    continue
                if node < first_leaf:
                    left, right = 2 * node + 1, 2 * node + 2
                    to_left = _box_distance(points, i, lower, upper, left)
                    to_right = _box_distance(points, i, lower, upper, right)
                    nearer = left if to_left <= to_right else right
                    stack[depth], stack[depth + 1] = left + right - nearer, nearer
                    depth += 2
                    continue
                start = (node - first_leaf) * LEAF
                for other in range(start, start + LEAF):
                    j = slots[other]
                    if j != none and j != i:
                        _insert(best, count, _distance(points, i, j))
            total = 0.0
            for k in range(count):
                total += best[k]
            found[i] = total / count
