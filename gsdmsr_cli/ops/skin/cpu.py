"""Lets splats follow the control points near them: blends their transforms; and gradients.

A transform has 19 columns, each the difference from what leaves a splat alone: a 3x3 matrix by rows
and an offset, which move a place x by (matrix x + offset); a quaternion, which turns q by
(quaternion q); and an offset of the log scales. A splat's transform is the mean of those of its
control points, with weights softmax(-d^2 / (2 r^2)) of its distances d to them and their radii r.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel, serial
from gsdmsr_cli.backends.cpu.rotation import rotation, rotation_backward

OFFSET, QUAT, GROWTH, COLUMNS = 9, 12, 16, 19
"""Where the parts of a transform behind its matrix begin, and how many columns it has."""

SHORTEST = 1e-4
"""Quaternions count as this long at least."""

_LANES = simd.LANES
_PLACE, _STEEPNESS, _AGAIN, _GROWTH, _SHARPNESS, _WIDTH = 16, 19, 20, 23, 26, 2 * _LANES
"""What rows of two vectors, in two cache lines, hold behind the first 16 columns of a transform.

That are its point's place, what squared distances are multiplied by for the powers of 2 that it
weighs, the place again, the transform's other columns, and the sharpness. Rows of sums hold the
same columns: gradients, and where the place stands again, that of the log radius by axis.
"""

_BLOCKS, _BATCH = 16, 16
"""Parts of all splats, whose sums are added in order; splats of a part that go side by side."""

_LOG2_E = float32(math.log2(math.e))
_LEAST_POWER = float32(-126)
_ZERO, _HALF, _ONE = float32(0), float32(0.5), float32(1)
_SHORTEST = float32(SHORTEST)
_INFINITE = float32(np.inf)


@inline
def _turn(deformation, j):
    """Return the quaternion of a point's deformation in unit length, and the length it had."""
    w, x = _ONE + deformation[j, 3], deformation[j, 4]
    y, z = deformation[j, 5], deformation[j, 6]
    norm = max(math.sqrt(w * w + x * x + y * y + z * z), _SHORTEST)
    return w / norm, x / norm, y / norm, z / norm, norm


@serial
def transform(points, deformation, transforms):
    """Write what control points do to the splats that follow them.

    Args:
        points: (M, 3) canonical places.
        deformation: (M, 10) offsets of place, of the quaternion (1, 0, 0, 0), of log scales.
        transforms: (M, 19) out.
    """
    for j in range(points.shape[0]):
        w, x, y, z, _ = _turn(deformation, j)
        for s, entry in enumerate(rotation(w, x, y, z)):
            transforms[j, s] = entry - _ONE if s % 4 == 0 else entry
        for r in range(3):
            shift = deformation[j, r]
            for s in range(3):
                shift -= transforms[j, 3 * r + s] * points[j, s]
            transforms[j, OFFSET + r] = shift
            transforms[j, GROWTH + r] = deformation[j, 7 + r]
        transforms[j, QUAT], transforms[j, QUAT + 1] = w - _ONE, x
        transforms[j, QUAT + 2], transforms[j, QUAT + 3] = y, z


@serial
def transform_backward(points, deformation, transforms, d_transforms, d_points, d_deformation):
    """Write the gradients of ``transform``.

    Args:
        transforms: (M, 19) what it wrote.
        d_transforms: (M, 19).
        d_points, d_deformation: (M, 3), (M, 10) out.
    """
    m = np.empty(9, np.float32)
    for j in range(points.shape[0]):
        for s in range(3):
            d_points[j, s] = _ZERO
        for r in range(3):
            given = d_transforms[j, OFFSET + r]
            for s in range(3):
                m[3 * r + s] = d_transforms[j, 3 * r + s] - given * points[j, s]
                d_points[j, s] -= given * transforms[j, 3 * r + s]
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
def _lay_out(points, sharpness, transforms):
    """Return the rows of all control points; what they leave free is 0."""
    rows = simd.empty_aligned(points.shape[0] * _WIDTH)
    rows[:] = _ZERO
    for j in range(points.shape[0]):
        at = j * _WIDTH
        for s in range(GROWTH):
            rows[at + s] = transforms[j, s]
        for s in range(3):
            rows[at + _GROWTH + s] = transforms[j, GROWTH + s]
            rows[at + _PLACE + s] = rows[at + _AGAIN + s] = points[j, s]
        rows[at + _STEEPNESS] = -_HALF * _LOG2_E * sharpness[j]
        rows[at + _SHARPNESS] = sharpness[j]
    return rows


@inline
def _columns(first, count):
    """Return the vector that is 1 in some columns of a row's second half, and 0 in the others."""
    return simd.first_lanes(first + count - _LANES) - simd.first_lanes(first - _LANES)


@inline
def _powers(means, i, rows, near, powers, at):
    """Write the powers of 2 that a splat's points weigh in proportion to; return the highest.

    By a vector for each point: gathering points' values by lanes would be slower.
    """
    highest, where = -_INFINITE, _columns(_PLACE, 3)
    x, y, z = (_columns(_PLACE, 1), _columns(_PLACE + 1, 1), _columns(_PLACE + 2, 1))
    place = means[i, 0] * x + means[i, 1] * y + means[i, 2] * z
    for k in range(near.shape[1]):
        j = near[i, k] * _WIDTH
        away = place - where * simd.load(rows, j + _LANES)
        power = rows[j + _STEEPNESS] * simd.reduce_first(away * away)
        powers[at + k] = power
        highest = max(highest, power)
    return highest


@inline
def _weigh(powers, at, kept, highest):
    """Turn the powers of a splat's control points into their weights."""
    total, least = simd.splat(_ZERO), simd.splat(_LEAST_POWER)
    for o in range(0, kept, _LANES):
        power = simd.maximum(least, simd.load(powers, at + o) - highest)
        # chosen, not multiplied by 0: of a far splat a free lane holds a power that is infinite
        weight = simd.where_positive(simd.first_lanes(kept - o), simd.exp2(power))
        total = total + weight
        simd.store(powers, at + o, weight)
    scale = _ONE / simd.reduce_sum(total)
    for o in range(0, kept, _LANES):
        simd.store(powers, at + o, simd.load(powers, at + o) * scale)


@inline
def _blend(rows, near, i, own, at, weights, blend):
    """Write the weights of a splat's control points, and the mean of their rows."""
    low, high = simd.splat(_ZERO), simd.splat(_ZERO)
    for k in range(near.shape[1]):
        j, weight = near[i, k] * _WIDTH, own[at + k]
        weights[i, k] = weight
        low = low + weight * simd.load(rows, j)
        high = high + weight * simd.load(rows, j + _LANES)
    simd.store(blend, 0, low)
    simd.store(blend, _LANES, high)


@inline
def _move(t, means, quats, log_scales, i, moved, turned, scaled):
    """Write where a transform takes a splat."""
    for r in range(3):
        shift = t[OFFSET + r]
        for s in range(3):
            shift += t[3 * r + s] * means[i, s]
        moved[i, r] = means[i, r] + shift
        scaled[i, r] = log_scales[i, r] + t[_GROWTH + r]
    a, b, c, d = t[QUAT], t[QUAT + 1], t[QUAT + 2], t[QUAT + 3]
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    turned[i, 0] = w + (a * w - b * x - c * y - d * z)
    turned[i, 1] = x + (a * x + b * w + c * z - d * y)
    turned[i, 2] = y + (a * y - b * z + c * w + d * x)
    turned[i, 3] = z + (a * z + b * y - c * x + d * w)


@parallel
def skin(
    means, quats, log_scales, points, sharpness, transforms, near, weights, moved, turned, scaled
):
    """Move N splats by M control points.

    Args:
        means, quats, log_scales: (N, 3), (N, 4), (N, 3).
        points: (M, 3).
        sharpness: (M,) inverse squared radii.
        transforms: (M, 19).
        near: (N, K) rows of the points of each splat.
        weights: (N, K) of these points, out.
        moved, turned, scaled: like the first three, out.
    """
    n, kept = near.shape
    padded = (kept + _LANES - 1) // _LANES * _LANES
    rows = _lay_out(points, sharpness, transforms)
    for block in prange(_BLOCKS):
        t, highest = np.empty(_WIDTH, np.float32), np.empty(_BATCH, np.float32)
        own = np.zeros(_BATCH * padded, np.float32)
        end = n * (block + 1) // _BLOCKS
        # in rounds, since what was written by parts can be read as a vector only a while later
        for first in range(n * block // _BLOCKS, end, _BATCH):
            batch = min(_BATCH, end - first)
            for b in range(batch):
                highest[b] = _powers(means, first + b, rows, near, own, b * padded)
            for b in range(batch):
                _weigh(own, b * padded, kept, highest[b])
            for b in range(batch):
                _blend(rows, near, first + b, own, b * padded, weights, t)
                _move(t, means, quats, log_scales, first + b, moved, turned, scaled)


@inline
def _transform_slopes(means, quats, d_moved, d_turned, d_scaled, i, d_t, at):
    """Write the gradient of a splat's transform, and behind it the splat's place."""
    for r in range(3):
        d_t[at + OFFSET + r], d_t[at + _GROWTH + r] = d_moved[i, r], d_scaled[i, r]
        d_t[at + _PLACE + r] = d_t[at + _AGAIN + r] = means[i, r]
        for s in range(3):
            d_t[at + 3 * r + s] = d_moved[i, r] * means[i, s]
    w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    e, f, g, h = d_turned[i, 0], d_turned[i, 1], d_turned[i, 2], d_turned[i, 3]
    d_t[at + QUAT] = e * w + f * x + g * y + h * z
    d_t[at + QUAT + 1] = -e * x + f * w - g * z + h * y
    d_t[at + QUAT + 2] = -e * y + f * z + g * w - h * x
    d_t[at + QUAT + 3] = -e * z - f * y + g * x + h * w


@inline
def _move_backward(t, d_moved, d_turned, pull, i, d_means, d_quats):
    """Write the gradients of a splat's place and quaternion; ``pull`` is what its weights add."""
    for r in range(3):
        d_means[i, r] = d_moved[i, r] - pull[r]
        for s in range(3):
            d_means[i, r] += t[3 * s + r] * d_moved[i, s]
    a, b, c, d = t[QUAT], t[QUAT + 1], t[QUAT + 2], t[QUAT + 3]
    e, f, g, h = d_turned[i, 0], d_turned[i, 1], d_turned[i, 2], d_turned[i, 3]
    d_quats[i, 0] = e + (e * a + f * b + g * c + h * d)
    d_quats[i, 1] = f + (-e * b + f * a + g * d - h * c)
    d_quats[i, 2] = g + (-e * c - f * d + g * a + h * b)
    d_quats[i, 3] = h + (-e * d + f * c - g * b + h * a)


@inline
def _follow_backward(rows, near, i, weights, d_t, at, totals, t, pull, sums):
    """Add to the sums of a splat's points; write its transform and what its weights add to d_means.

    Args:
        d_t, at: the gradient of its transform and its place, and where they begin.
        totals: (K,) memory.
        t, pull: out; the pull is in the first three lanes.
    """
    place, again = _columns(_PLACE, 3), _columns(_AGAIN, 3)
    d_low, high = simd.load(d_t, at), simd.load(d_t, at + _LANES)
    places = place + again
    where = places * high
    d_high = high - where
    low, mean, drawn = simd.splat(_ZERO), _ZERO, simd.splat(_ZERO)
    for k in range(near.shape[1]):
        j, own = near[i, k] * _WIDTH, weights[i, k]
        row = simd.load(rows, j)
        low = low + own * row
        totals[k] = simd.reduce_sum(row * d_low + simd.load(rows, j + _LANES) * d_high)
        mean += own * totals[k]
    for k in range(near.shape[1]):
        j, own = near[i, k] * _WIDTH, weights[i, k]
        slope = own * (totals[k] - mean) * rows[j + _SHARPNESS]
        away = where - places * simd.load(rows, j + _LANES)
        further = slope * away
        drawn = drawn + further
        added = own * d_high + further * (place + again * away)
        simd.store(sums, j, simd.load(sums, j) + own * d_low)
        simd.store(sums, j + _LANES, simd.load(sums, j + _LANES) + added)
    simd.store(t, 0, low)
    simd.store(pull, 0, drawn)


@inline
def _is_finite(quats, weights, i):
    """Return whether a splat's values are finite; means that are not make all weights NaN."""
    total = quats[i, 0] + quats[i, 1] + quats[i, 2] + quats[i, 3]
    return abs(total + weights[i, 0]) < _INFINITE


@inline
def _sum_blocks(sums, j, d_points, d_log_radii, d_transforms):
    """Write the gradients of a point, the sums of all blocks."""
    at = j * _WIDTH
    low, high = simd.splat(_ZERO), simd.splat(_ZERO)
    for block in range(_BLOCKS):
        low = low + simd.load(sums[block], at)
        high = high + simd.load(sums[block], at + _LANES)
    simd.store(sums[0], at, low)
    simd.store(sums[0], at + _LANES, high)
    for s in range(GROWTH):
        d_transforms[j, s] = sums[0, at + s]
    for s in range(3):
        d_transforms[j, GROWTH + s] = sums[0, at + _GROWTH + s]
        d_points[j, s] = sums[0, at + _PLACE + s]
    d_log_radii[j] = sums[0, at + _AGAIN] + sums[0, at + _AGAIN + 1] + sums[0, at + _AGAIN + 2]


@parallel
def skin_backward(
    means, quats, points, sharpness, transforms, near, weights, d_moved, d_turned, d_scaled,
    d_means, d_quats, d_points, d_log_radii, d_transforms,
):  # fmt: skip
    """Write the gradients of ``skin``; that of the log scales is ``d_scaled``.

    Splats that are not finite add nothing to their points' gradients.

    Args:
        d_moved, d_turned, d_scaled: (N, 3), (N, 4), (N, 3).
        d_means, d_quats: (N, 3), (N, 4) out.
        d_points: (M, 3) out, by the weights alone.
        d_log_radii, d_transforms: (M,), (M, 19) out.
    """
    n, kept = near.shape
    count = points.shape[0]
    rows = _lay_out(points, sharpness, transforms)
    sums = simd.empty_aligned(_BLOCKS * count * _WIDTH).reshape((_BLOCKS, count * _WIDTH))
    for block in prange(_BLOCKS):
        t, pull = np.empty(_LANES, np.float32), np.empty(_LANES, np.float32)
        d_t, totals = np.zeros(_BATCH * _WIDTH, np.float32), np.empty(kept, np.float32)
        own, end = sums[block], n * (block + 1) // _BLOCKS
        own[:] = _ZERO
        for first in range(n * block // _BLOCKS, end, _BATCH):
            last = min(first + _BATCH, end)
            for i in range(first, last):
                at = (i - first) * _WIDTH
                _transform_slopes(means, quats, d_moved, d_turned, d_scaled, i, d_t, at)
            for i in range(first, last):
                if not _is_finite(quats, weights, i):  # 0 times NaN would be NaN to its points
                    d_means[i], d_quats[i] = d_moved[i], d_turned[i]
                    continue
                at = (i - first) * _WIDTH
                _follow_backward(rows, near, i, weights, d_t, at, totals, t, pull, own)
                _move_backward(t, d_moved, d_turned, pull, i, d_means, d_quats)
    for j in prange(count):
        _sum_blocks(sums, j, d_points, d_log_radii, d_transforms)
