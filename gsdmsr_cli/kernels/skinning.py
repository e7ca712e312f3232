"""Lets splats follow the nodes near them: search, blending of the nodes' transforms, gradients.

A transform has 19 columns, each the difference from what leaves a splat alone: a 3x3 matrix by rows
and an offset, which move a place x by (matrix x + offset); a quaternion, which turns q by
(quaternion q); and an offset of the log scales. A splat's transform is the mean of its nodes', with
weights softmax(-d^2 / (2 r^2)) of its distances d to them and their radii r.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, prange

from gsdmsr_cli.kernels import simd
from gsdmsr_cli.kernels.jit import inline, parallel, serial
from gsdmsr_cli.kernels.rotation import rotation, rotation_backward

OFFSET, QUAT, GROWTH, COLUMNS = 9, 12, 16, 19
"""Where the parts of a transform behind its matrix begin, and how many columns it has."""

SHORTEST = 1e-4
"""Quaternions count as this long at least."""

_LANES = simd.LANES
_BLOCKS = 16
_ZERO, _HALF, _ONE = float32(0), float32(0.5), float32(1)
_SHORTEST = float32(SHORTEST)
_FAR = float32(1e18)
_INFINITE = float32(np.inf)
_SLACK = float32(1.0001)
"""A distance that is worked out anew may round otherwise than a bound on it."""


@serial
def choose_spread(points, rows):
    """Write the rows of points (N, 3) that are far from each other.

    The first is row 0, every other one the farthest from those before it (Gonzalez 1985).
    """
    n = points.shape[0]
    away = np.full(n, np.inf)
    chosen = 0
    for m in range(rows.shape[0]):
        rows[m] = chosen
        farthest = 0
        for i in range(n):
            x = points[i, 0] - points[rows[m], 0]
            y = points[i, 1] - points[rows[m], 1]
            z = points[i, 2] - points[rows[m], 2]
            away[i] = min(away[i], x * x + y * y + z * z)
            if away[i] > away[farthest]:
                farthest = i
        chosen = farthest


@inline
def _group(nodes, flat, corners, padded, boxes):
    """Lay nodes out by axis and write the boxes of every 16 in a row, also by axis."""
    for g in range(padded // _LANES):
        for axis in range(3):
            low, high = _FAR, -_FAR
            for j in range(g * _LANES, min(nodes.shape[0], (g + 1) * _LANES)):
                flat[axis * padded + j] = nodes[j, axis]
                low, high = min(low, nodes[j, axis]), max(high, nodes[j, axis])
            corners[axis * boxes + g] = low
            corners[(3 + axis) * boxes + g] = high


@inline
def _outside(x, corners, boxes, axis, at):
    """Return how far x is outside 16 boxes along an axis."""
    below = simd.load(corners, axis * boxes + at) - x
    above = x - simd.load(corners, (3 + axis) * boxes + at)
    return simd.maximum(simd.maximum(below, above), simd.splat(_ZERO))


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
def _distances(x, y, z, flat, padded, j):
    """Return the squared distances to 16 nodes in a row."""
    a = simd.load(flat, j) - x
    b = simd.load(flat, padded + j) - y
    c = simd.load(flat, 2 * padded + j) - z
    return a * a + b * b + c * c


@inline
def _nodes_within(x, y, z, flat, padded, bound):
    """Return how many nodes lie within a squared distance."""
    limit, one, count = simd.splat(bound), simd.splat(float32(1)), simd.splat(_ZERO)
    for j in range(0, padded, _LANES):
        count = count + simd.where_ge(limit, _distances(x, y, z, flat, padded, j), one)
    return int(simd.reduce_sum(count))


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

    Guesses mostly prove right: then no other node lies within their distance, which is counted
    without a branch. The others are searched for in the boxes that are near enough.

    Args:
        points: (N, 3).
        nodes: (M, 3); it is quick where those that follow each other lie near each other.
        near: (N, K) int32, K at most M; in: guesses, an earlier result or zeros; out: the rows of
            the nearest, in ascending order; of equally near ones the first.
    """
    n, kept = near.shape
    padded = (nodes.shape[0] + _LANES - 1) // _LANES * _LANES
    boxes = (padded // _LANES + _LANES - 1) // _LANES * _LANES
    flat, corners = np.full(3 * padded, _FAR), np.full(6 * boxes, _FAR)
    _group(nodes, flat, corners, padded, boxes)
    for block in prange(_BLOCKS):
        away, distances = np.empty(boxes, np.float32), np.empty(_LANES, np.float32)
        best = np.empty(kept, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            x, y, z = simd.splat(points[i, 0]), simd.splat(points[i, 1]), simd.splat(points[i, 2])
            bound = _bound(points, i, nodes, near)
            if bound < _INFINITE and _nodes_within(x, y, z, flat, padded, bound) == kept:
                continue
            best[:] = bound
            for o in range(0, boxes, _LANES):
                a = _outside(x, corners, boxes, 0, o)
                b = _outside(y, corners, boxes, 1, o)
                c = _outside(z, corners, boxes, 2, o)
                simd.store(away, o, a * a + b * b + c * c)
            for g in range(padded // _LANES):
                if away[g] >= best[kept - 1]:
                    continue
                simd.store(distances, 0, _distances(x, y, z, flat, padded, g * _LANES))
                for lane in range(min(_LANES, nodes.shape[0] - g * _LANES)):
                    if distances[lane] < best[kept - 1]:
                        k = kept - 1
                        while k > 0 and best[k - 1] > distances[lane]:
                            best[k], near[i, k] = best[k - 1], near[i, k - 1]
                            k -= 1
                        best[k], near[i, k] = distances[lane], g * _LANES + lane
            _sort(near, i)


@inline
def _turn(deformation, j):
    """Return the quaternion of a node's deformation in unit length, and the length it had."""
    w, x = _ONE + deformation[j, 3], deformation[j, 4]
    y, z = deformation[j, 5], deformation[j, 6]
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), _SHORTEST)
    return w / norm, x / norm, y / norm, z / norm, norm


@serial
def transform(nodes, deformation, transforms):
    """Write what nodes do to the splats that follow them.

    Args:
        nodes: (M, 3) canonical places.
        deformation: (M, 10) offsets of place, of the quaternion (1, 0, 0, 0), of log scales.
        transforms: (M, 19) out.
    """
    for j in range(nodes.shape[0]):
        w, x, y, z, _ = _turn(deformation, j)
        for s, entry in enumerate(rotation(w, x, y, z)):
            transforms[j, s] = entry - _ONE if s % 4 == 0 else entry
        for r in range(3):
            shift = deformation[j, r]
            for s in range(3):
                shift -= transforms[j, 3 * r + s] * nodes[j, s]
            transforms[j, OFFSET + r] = shift
            transforms[j, GROWTH + r] = deformation[j, 7 + r]
        transforms[j, QUAT], transforms[j, QUAT + 1] = w - _ONE, x
        transforms[j, QUAT + 2], transforms[j, QUAT + 3] = y, z


@serial
def transform_backward(nodes, deformation, transforms, d_transforms, d_nodes, d_deformation):
    """Write the gradients of ``transform``.

    Args:
        transforms: (M, 19) what it wrote.
        d_transforms: (M, 19).
        d_nodes, d_deformation: (M, 3), (M, 10) out.
    """
    m = np.empty(9, np.float32)
    for j in range(nodes.shape[0]):
        for s in range(3):
            d_nodes[j, s] = _ZERO
        for r in range(3):
            given = d_transforms[j, OFFSET + r]
            for s in range(3):
                m[3 * r + s] = d_transforms[j, 3 * r + s] - given * nodes[j, s]
                d_nodes[j, s] -= given * transforms[j, 3 * r + s]
            d_deformation[j, r] = given
            d_deformation[j, 7 + r] = d_transforms[j, GROWTH + r]
        w, x, y, z, norm = _turn(deformation, j)
        a, b, c, d = rotation_backward(
            w, x, y, z, m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]
        )
        a, b = a + d_transforms[j, QUAT], b + d_transforms[j, QUAT + 1]
        c, d = c + d_transforms[j, QUAT + 2], d + d_transforms[j, QUAT + 3]
        along = a * w + b * x + c * y + d * z
        d_deformation[j, 3] = (a - along * w) / norm
        d_deformation[j, 4] = (b - along * x) / norm
        d_deformation[j, 5] = (c - along * y) / norm
        d_deformation[j, 6] = (d - along * z) / norm


@inline
def _weigh(means, i, nodes, sharpness, near, weights):
    """Write the weights of a splat's nodes."""
    kept, highest, total = near.shape[1], -_INFINITE, _ZERO
    for k in range(kept):
        weights[i, k] = -_HALF * _square(means, i, nodes, near[i, k]) * sharpness[near[i, k]]
        highest = max(highest, weights[i, k])
    for k in range(kept):
        weights[i, k] = math.exp(weights[i, k] - highest)
        total += weights[i, k]
    for k in range(kept):
        weights[i, k] /= total


@inline
def _blend(transforms, near, i, weights, blend):
    """Write the mean of the transforms of a splat's nodes."""
    for c in range(COLUMNS):
        blend[c] = _ZERO
    for k in range(near.shape[1]):
        j, w = near[i, k], weights[i, k]
        for c in range(COLUMNS):
            blend[c] += w * transforms[j, c]


@parallel
def skin(
    means, quats, log_scales, nodes, sharpness, transforms, near, weights, moved, turned, scaled
):
    """Move N splats by M nodes.

    Args:
        means, quats, log_scales: (N, 3), (N, 4), (N, 3).
        nodes: (M, 3).
        sharpness: (M,) inverse squared radii.
        transforms: (M, 19).
        near: (N, K) rows of the nodes of each splat.
        weights: (N, K) of these nodes, out.
        moved, turned, scaled: like the first three, out.
    """
    n = near.shape[0]
    for block in prange(_BLOCKS):
        t = np.empty(COLUMNS, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            _weigh(means, i, nodes, sharpness, near, weights)
            _blend(transforms, near, i, weights, t)
            for r in range(3):
                shift = t[OFFSET + r]
                for s in range(3):
                    shift += t[3 * r + s] * means[i, s]
                moved[i, r] = means[i, r] + shift
                scaled[i, r] = log_scales[i, r] + t[GROWTH + r]
            a, b, c, d = t[QUAT], t[QUAT + 1], t[QUAT + 2], t[QUAT + 3]
            w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            turned[i, 0] = w + (a * w - b * x - c * y - d * z)
            turned[i, 1] = x + (a * x + b * w + c * z - d * y)
            turned[i, 2] = y + (a * y - b * z + c * w + d * x)
            turned[i, 3] = z + (a * z + b * y - c * x + d * w)


@parallel
def skin_backward(
    means, quats, nodes, sharpness, transforms, near, weights, d_moved, d_turned, d_scaled,
    d_means, d_quats, d_nodes, d_log_radii, d_transforms,
):  # fmt: skip
    """Write the gradients of ``skin``; that of the log scales is ``d_scaled``.

    Args:
        d_moved, d_turned, d_scaled: (N, 3), (N, 4), (N, 3).
        d_means, d_quats: (N, 3), (N, 4) out.
        d_nodes: (M, 3) out, by the weights alone.
        d_log_radii, d_transforms: (M,), (M, 19) out.
    """
    n, kept = near.shape
    count, width = nodes.shape[0], COLUMNS + 4
    sums = np.zeros((_BLOCKS, count, width), np.float32)
    for block in prange(_BLOCKS):
        t, d_t = np.empty(COLUMNS, np.float32), np.empty(COLUMNS, np.float32)
        d_weights = np.empty(kept, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            _blend(transforms, near, i, weights, t)
            for r in range(3):
                d_t[OFFSET + r], d_t[GROWTH + r] = d_moved[i, r], d_scaled[i, r]
                d_means[i, r] = d_moved[i, r]
                for s in range(3):
                    d_t[3 * r + s] = d_moved[i, r] * means[i, s]
                    d_means[i, r] += t[3 * s + r] * d_moved[i, s]
            a, b, c, d = t[QUAT], t[QUAT + 1], t[QUAT + 2], t[QUAT + 3]
            w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            e, f, g, h = d_turned[i, 0], d_turned[i, 1], d_turned[i, 2], d_turned[i, 3]
            d_t[QUAT] = e * w + f * x + g * y + h * z
            d_t[QUAT + 1] = -e * x + f * w - g * z + h * y
            d_t[QUAT + 2] = -e * y + f * z + g * w - h * x
            d_t[QUAT + 3] = -e * z - f * y + g * x + h * w
            d_quats[i, 0] = e + (e * a + f * b + g * c + h * d)
            d_quats[i, 1] = f + (-e * b + f * a + g * d - h * c)
            d_quats[i, 2] = g + (-e * c - f * d + g * a + h * b)
            d_quats[i, 3] = h + (-e * d + f * c - g * b + h * a)
            mean = _ZERO
            for k in range(kept):
                j, own, total = near[i, k], weights[i, k], _ZERO
                for s in range(COLUMNS):
                    total += transforms[j, s] * d_t[s]
                    sums[block, j, s] += own * d_t[s]
                d_weights[k] = total
                mean += own * total
            for k in range(kept):
                j = near[i, k]
                given = weights[i, k] * (d_weights[k] - mean) * sharpness[j]
                sums[block, j, COLUMNS + 3] += given * _square(means, i, nodes, j)
                for s in range(3):
                    pull = given * (means[i, s] - nodes[j, s])
                    d_means[i, s] -= pull
                    sums[block, j, COLUMNS + s] += pull
    for j in prange(count):
        for block in range(1, _BLOCKS):
            for s in range(width):
                sums[0, j, s] += sums[block, j, s]
        for s in range(COLUMNS):
            d_transforms[j, s] = sums[0, j, s]
        for s in range(3):
            d_nodes[j, s] = sums[0, j, COLUMNS + s]
        d_log_radii[j] = sums[0, j, COLUMNS + 3]
