"""Looks features up in a HexPlane level and scatters gradients back (Cao & Johnson 2023).

A level holds three spatial planes (xy, xz, yz) and three temporal ones (x, y, z against time).
Channels come in chunks of 16, one vector: space is (3, chunks, R, R, 16) with the plane's second
axis first, time is (3, chunks, T, R, 16). All points of a frame share one time, so the temporal
planes collapse to three lines once a frame, along straight lines or cubic curves. The feature is
the product of the six bilinear or linear samples, positions clamped to the border. One call serves
all levels.
"""

from __future__ import annotations

from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel

_LANES = simd.LANES
_BLOCKS = 64
_HALF = float32(0.5)
_ONE = float32(1)
_TWO_THIRDS, _SIXTH = float32(2 / 3), float32(1 / 6)


@inline
def cell(x, size):
    """Return the lower node and the weight of the upper one for x in [-1, 1] on ``size`` nodes.

    What is not a number is taken for -1, as CUDA's fmaxf does: any node will do, as long as there
    is one and its weight is finite.
    """
    u, last = (x + _ONE) * _HALF * float32(size - 1), float32(size - 1)
    u = u if u > float32(0) else float32(0)
    u = u if u < last else last
    i = min(int(u), size - 2)
    return i, u - float32(i)


@inline
def _bump(x):
    """Return the uniform cubic B-spline at x nodes from its middle."""
    x = abs(x)
    if x < _ONE:
        return _TWO_THIRDS + x * x * (_HALF * x - _ONE)
    rest = float32(2) - x
    return rest * rest * rest * _SIXTH if rest > float32(0) else float32(0)


@inline
def _weight(node, i, w, size, cubic):
    """Return what a node counts w cells beyond node i of ``size``, see ``levels.cubic_weights``.

    On straight lines these are nodes i and i + 1 alone.
    """
    if not cubic:
        return w if node > i else _ONE - w
    weight = _bump(float32(node - i) - w)
    before, after = _bump(float32(-1 - i) - w), _bump(float32(size - i) - w)
    if node == 0:
        weight += float32(2) * before
    if node == 1:
        weight -= before
    if node == size - 1:
        weight += float32(2) * after
    if node == size - 2:
        weight -= after
    return weight


@inline
def collapse(planes, time, cubic, lines, axis, chunk):
    """Interpolate a chunk of one of (3, chunks, T, R, 16) temporal planes at ``time`` to a line."""
    size = planes.shape[2]
    i, w = cell(time, size)
    if cubic:
        lines[axis, chunk] = float32(0)
        for node in range(max(i - 1, 0), min(i + 3, size)):
            weight = _weight(node, i, w, size, cubic)
            for r in range(planes.shape[3]):
                for k in range(_LANES):
                    lines[axis, chunk, r, k] += planes[axis, chunk, node, r, k] * weight
        return
    for r in range(planes.shape[3]):
        for k in range(_LANES):
            low, high = planes[axis, chunk, i, r, k], planes[axis, chunk, i + 1, r, k]
            lines[axis, chunk, r, k] = low + (high - low) * w


@inline
def spread(d_lines, time, cubic, d_planes, axis, chunk):
    """Write the gradient of a chunk of a temporal plane: that of the line at few times, else 0."""
    size = d_planes.shape[2]
    i, w = cell(time, size)
    first, last = (max(i - 1, 0), min(i + 2, size - 1)) if cubic else (i, i + 1)
    d_planes[axis, chunk, :first] = float32(0)
    d_planes[axis, chunk, last + 1 :] = float32(0)
    for node in range(first, last + 1):
        weight = _weight(node, i, w, size, cubic)
        for r in range(d_planes.shape[3]):
            for k in range(_LANES):
                d_planes[axis, chunk, node, r, k] = d_lines[axis, chunk, r, k] * weight


@inline
def _bilinear(flat, at, row, wx, wy):
    """Return a bilinear sample and its derivatives by x and y, in cells."""
    c00, c01 = simd.load(flat, at), simd.load(flat, at + _LANES)
    c10, c11 = simd.load(flat, at + row), simd.load(flat, at + row + _LANES)
    low_x, high_x = c01 - c00, c11 - c10
    low = c00 + low_x * wx
    by_y = c10 + high_x * wx - low
    return low + by_y * wy, low_x + (high_x - low_x) * wy, by_y


@inline
def _linear(flat, at, w):
    """Return a linear sample and its derivative, in cells."""
    low = simd.load(flat, at)
    by_x = simd.load(flat, at + _LANES) - low
    return low + by_x * w, by_x


@inline
def _in_box(points, box, i, axis):
    """Return a coordinate of a point where the box reaches from -1 to 1."""
    return points[i, axis] * box[0, axis] + box[1, axis]


@parallel
def lookup(points, box, time, cubic, spaces, times, lines, features):
    """Write the (N, C) features of (N, 3) points.

    Args:
        points: positions; times ``box[0]`` plus ``box[1]`` (2, 3) they lie in [-1, 1].
        cubic: whether cubic B-splines lie between the nodes in time, not straight lines.
        spaces, times: the planes, one array per level.
        lines: one array (3, chunks, R, 16) per level, out: the temporal planes at ``time``.
        features: out, the levels side by side; columns beyond theirs are left as they are.
    """
    n, out, width = points.shape[0], features.reshape(-1), features.shape[1]
    for level in range(len(spaces)):
        for axis in range(3):
            for chunk in range(spaces[level].shape[1]):
                collapse(times[level], float32(time), cubic, lines[level], axis, chunk)
    for block in prange(_BLOCKS):
        offset = 0
        for level in range(len(spaces)):
            space = spaces[level]
            size, chunks = space.shape[2], space.shape[1]
            planes, strips = space.reshape(-1), lines[level].reshape(-1)
            row, plane, strip = size * _LANES, size * size * _LANES, size * _LANES
            for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
                ix, wx = cell(_in_box(points, box, i, 0), size)
                iy, wy = cell(_in_box(points, box, i, 1), size)
                iz, wz = cell(_in_box(points, box, i, 2), size)
                x_at, y_at, z_at = ix * _LANES, iy * _LANES, iz * _LANES
                for c in range(chunks):
                    xy, xz, yz = c * plane, (chunks + c) * plane, (2 * chunks + c) * plane
                    x, y, z = c * strip, (chunks + c) * strip, (2 * chunks + c) * strip
                    value = _bilinear(planes, xy + iy * row + x_at, row, wx, wy)[0]
                    value = value * _bilinear(planes, xz + iz * row + x_at, row, wx, wz)[0]
                    value = value * _bilinear(planes, yz + iz * row + y_at, row, wy, wz)[0]
                    value = value * _linear(strips, x + x_at, wx)[0]
                    value = value * _linear(strips, y + y_at, wy)[0]
                    value = value * _linear(strips, z + z_at, wz)[0]
                    simd.store(out, i * width + offset + c * _LANES, value)
            offset += chunks * _LANES


@inline
def _add(flat, at, value):
    simd.store(flat, at, simd.load(flat, at) + value)


@inline
def _scatter_linear(flat, at, w, d):
    upper = d * w
    _add(flat, at, d - upper)
    _add(flat, at + _LANES, upper)


@inline
def _scatter_bilinear(flat, at, row, wx, wy, d):
    upper = d * wy
    _scatter_linear(flat, at, wx, d - upper)
    _scatter_linear(flat, at + row, wx, upper)


@parallel
def lookup_backward(
    points, box, time, cubic, spaces, lines, d_features, d_spaces, d_times, d_lines, shares,
    d_points,
):  # fmt: skip
    """Write the gradients of the planes and, if wanted, of the points.

    Every thread owns whole chunks of 16 channels, so that threads never write to one place and
    the sums do not depend on their number. Points outside [-1, 1] get no gradient along that axis.

    Args:
        points, box, time, cubic, spaces, lines: see ``lookup``.
        d_features: (N, C or more) of all levels side by side.
        d_spaces, d_times: out, one array per level.
        d_lines: room for the gradients of ``lines``.
        shares: (C / 16, N, 3) room for what each chunk adds to ``d_points``.
        d_points: (N, 3) out, or (0, 3) if not wanted.
    """
    n, width, d_out = points.shape[0], d_features.shape[1], d_features.reshape(-1)
    for task in prange(shares.shape[0]):
        level, before = 0, 0
        while task >= before + spaces[level].shape[1]:
            before += spaces[level].shape[1]
            level += 1
        c = task - before
        space, d_space, d_line = spaces[level], d_spaces[level], d_lines[level]
        chunks, size = space.shape[1], space.shape[2]
        planes, strips = space.reshape(-1), lines[level].reshape(-1)
        d_planes, d_strips = d_space.reshape(-1), d_line.reshape(-1)
        row, plane, strip = size * _LANES, size * size * _LANES, size * _LANES
        cells = _HALF * float32(size - 1)
        for axis in range(3):
            d_space[axis, c] = float32(0)
            d_line[axis, c] = float32(0)
        for i in range(n):
            px, py, pz = (
                _in_box(points, box, i, 0),
                _in_box(points, box, i, 1),
                _in_box(points, box, i, 2),
            )
            ix, wx = cell(px, size)
            iy, wy = cell(py, size)
            iz, wz = cell(pz, size)
            xy = c * plane + iy * row + ix * _LANES
            xz = (chunks + c) * plane + iz * row + ix * _LANES
            yz = (2 * chunks + c) * plane + iz * row + iy * _LANES
            x = c * strip + ix * _LANES
            y = (chunks + c) * strip + iy * _LANES
            z = (2 * chunks + c) * strip + iz * _LANES
            s_xy, xy_by_x, xy_by_y = _bilinear(planes, xy, row, wx, wy)
            s_xz, xz_by_x, xz_by_z = _bilinear(planes, xz, row, wx, wz)
            s_yz, yz_by_y, yz_by_z = _bilinear(planes, yz, row, wy, wz)
            s_x, by_x = _linear(strips, x, wx)
            s_y, by_y = _linear(strips, y, wy)
            s_z, by_z = _linear(strips, z, wz)
            d = simd.load(d_out, i * width + task * _LANES)
            d_time = d * (s_x * s_y * s_z)
            d_xy, d_xz, d_yz = d_time * s_xz * s_yz, d_time * s_xy * s_yz, d_time * s_xy * s_xz
            d = d * (s_xy * s_xz * s_yz)
            d_x, d_y, d_z = d * s_y * s_z, d * s_x * s_z, d * s_x * s_y
            if d_points.shape[0] > 0:
                gx = d_xy * xy_by_x + d_xz * xz_by_x + d_x * by_x
                gy = d_xy * xy_by_y + d_yz * yz_by_y + d_y * by_y
                gz = d_xz * xz_by_z + d_yz * yz_by_z + d_z * by_z
                shares[task, i, 0] = _inside(px) * cells * box[0, 0] * simd.reduce_sum(gx)
                shares[task, i, 1] = _inside(py) * cells * box[0, 1] * simd.reduce_sum(gy)
                shares[task, i, 2] = _inside(pz) * cells * box[0, 2] * simd.reduce_sum(gz)
            _scatter_bilinear(d_planes, xy, row, wx, wy, d_xy)
            _scatter_bilinear(d_planes, xz, row, wx, wz, d_xz)
            _scatter_bilinear(d_planes, yz, row, wy, wz, d_yz)
            _scatter_linear(d_strips, x, wx, d_x)
            _scatter_linear(d_strips, y, wy, d_y)
            _scatter_linear(d_strips, z, wz, d_z)
        for axis in range(3):
            spread(d_line, float32(time), cubic, d_times[level], axis, c)
    for block in prange(_BLOCKS):
        rows = d_points.shape[0]
        for i in range(rows * block // _BLOCKS, rows * (block + 1) // _BLOCKS):
            for axis in range(3):
                total = float32(0)
                for task in range(shares.shape[0]):
                    total += shares[task, i, axis]
                d_points[i, axis] = total


@inline
def _inside(x):
    return _ONE if -_ONE <= x <= _ONE else float32(0)


@parallel
def space_penalty(space, weight, d_space, sums):
    """Write the gradient of weight * sum over planes of mean squared first differences.

    ``sums`` (3 * chunks,) float64 gets the shares of the value. Total variation in both axes of a
    plane, as in K-Planes (Fridovich-Keil et al. 2023, section 3.1).
    """
    chunks, size = space.shape[1], space.shape[2]
    flat, d_flat = space.reshape(-1), d_space.reshape(-1)
    row, plane = size * _LANES, size * size * _LANES
    scale = float32(weight) / float32(chunks * _LANES * size * (size - 1))
    for task in prange(3 * chunks):
        at = task * plane
        for k in range(plane):
            d_flat[at + k] = float32(0)
        total = simd.splat(float32(0))
        for r in range(size):
            for c in range(size):
                o = at + r * row + c * _LANES
                here = simd.load(flat, o)
                if c + 1 < size:
                    step = here - simd.load(flat, o + _LANES)
                    total = total + step * step
                    step = step * (float32(2) * scale)
                    _add(d_flat, o, step)
                    simd.store(d_flat, o + _LANES, simd.load(d_flat, o + _LANES) - step)
                if r + 1 < size:
                    step = here - simd.load(flat, o + row)
                    total = total + step * step
                    step = step * (float32(2) * scale)
                    _add(d_flat, o, step)
                    simd.store(d_flat, o + row, simd.load(d_flat, o + row) - step)
        sums[task] = simd.reduce_sum(total) * scale


@parallel
def time_penalty(planes, smooth_weight, still_weight, d_planes, sums):
    """Write the gradient of two penalties on temporal planes, each a sum over planes of means.

    ``smooth_weight`` is that of squared second differences in time, ``still_weight`` that of
    |1 - value| (HexPlane; 4D-GS, section 4.3). ``sums`` (3 * chunks,) float64 gets the value's
    shares.
    """
    chunks, times, size = planes.shape[1], planes.shape[2], planes.shape[3]
    flat, d_flat = planes.reshape(-1), d_planes.reshape(-1)
    row, plane = size * _LANES, times * size * _LANES
    smooth = float32(smooth_weight) / float32(chunks * _LANES * size * max(times - 2, 1))
    still = float32(still_weight) / float32(chunks * _LANES * size * times)
    for task in prange(3 * chunks):
        at = task * plane
        one, two = simd.splat(_ONE), float32(2)
        up, down = simd.splat(still), simd.splat(-still)
        total, distance = simd.splat(float32(0)), simd.splat(float32(0))
        for o in range(at, at + plane, _LANES):
            away = simd.load(flat, o) - one
            distance = distance + simd.maximum(away, one - one - away)
            sign = simd.where_positive(away, up) + simd.where_positive(one - one - away, down)
            simd.store(d_flat, o, sign)
        for t in range(1, times - 1):
            for o in range(at + t * row, at + (t + 1) * row, _LANES):
                bend = simd.load(flat, o - row) - simd.load(flat, o) * two
                bend = bend + simd.load(flat, o + row)
                total = total + bend * bend
                bend = bend * (two * smooth)
                _add(d_flat, o - row, bend)
                _add(d_flat, o, bend * -two)
                _add(d_flat, o + row, bend)
        sums[task] = simd.reduce_sum(total) * smooth + simd.reduce_sum(distance) * still
