"""How far a drawn picture is from an 8-bit target by colours and by SSIM, with the gradients.

SSIM is that of 3DGS: an 11 x 11 Gaussian window of sigma 1.5, zero padding, averaged over pixels
and channels (Wang et al. 2004). Pictures are planes (3, H', W') whose width is a multiple of 16 and
whose part beyond H x W does not count.

Where both pictures are the same, SSIM is 1 and has no gradient; most of what lies behind an object
is never looked at again.
"""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel, serial
from gsdmsr_cli.ground import ssim

STRIP = 32
"""Rows that one task handles at a time; its horizontal sums stay in cache. Two blocks high."""

_LANES = simd.LANES
_REACH = ssim.REACH
_C1, _C2 = float32(ssim.C1), float32(ssim.C2)
_MARGIN = _LANES
WINDOW = ssim.WINDOW.astype(np.float32)
_W0, _W1, _W2, _W3, _W4, _W5 = (float32(w) for w in WINDOW[: _REACH + 1])
_SCALE = float32(1 / 255)
_BLOCK = _LANES
_UNREAD, _ZEROS, _NEEDED = 0, 1, 2


@parallel
def to_float(target, planes):
    """Write an 8-bit target (3, H, W) as planes (3, H', W') in [0, 1], 0 outside the picture."""
    channels, height, width = target.shape
    pixels, out, stride = target.reshape(-1), planes.reshape(-1), planes.shape[2]
    for task in prange(channels * planes.shape[1]):
        channel, y = task // planes.shape[1], task % planes.shape[1]
        if y >= height:
            planes[channel, y] = float32(0)
            continue
        row = np.empty(_LANES, np.float32)
        for x in range(0, stride, _LANES):
            values = load_target(pixels, (channel * height + y) * width + x, width - x, row)
            simd.store(out, task * stride + x, values)


@parallel
def distance(drawn, target, height, width, weight, steep, half, gradient, sums):
    """Write the sums over rows of how far colours are apart, and weight times their slopes.

    Args:
        drawn, gradient: planes (3, H', W'); the gradient is 0 outside the picture.
        target: (3, H, W) uint8.
        weight, steep, half: see ``distances``.
        sums: (3 * H',) out.
    """
    rows, stride = drawn.shape[1], drawn.shape[2]
    flat, pixels, out = drawn.reshape(-1), target.reshape(-1), gradient.reshape(-1)
    for task in prange(3 * rows):
        channel, y = task // rows, task % rows
        if y >= height:
            gradient[channel, y] = float32(0)
            sums[task] = 0
            continue
        row, total = np.empty(_LANES, np.float32), simd.splat(float32(0))
        for x in range(0, stride, _LANES):
            at, inside = task * stride + x, width - x
            wanted = load_target(pixels, (channel * height + y) * width + x, inside, row)
            shown = simd.load(flat, at) * simd.first_lanes(inside)
            apart, slope = distances(shown - wanted, weight, steep, half)
            simd.store(out, at, slope)
            total = total + apart
        sums[task] = simd.reduce_sum(total)


@inline
def load_target(pixels, at, inside, row):
    """Return 16 values of a flat 8-bit picture in [0, 1], 0 beyond the first ``inside`` of them.

    Args:
        row: (16,) scratch.
    """
    if inside >= _LANES:
        return simd.load_bytes(pixels, at) * _SCALE
    for x in range(_LANES):
        row[x] = float32(pixels[at + x]) if x < inside else float32(0)
    return simd.load(row, 0) * _SCALE


@inline
def distances(differences, weight, steep, half):
    """Return how far colours are apart in every lane, and weight times its slope.

    That is Huber's loss, divided by the q up to which differences count by their squares.

    Args:
        steep, half: 1 / q and q / 2; so steep that any difference is beyond q, and 0, for |d|.
    """
    zero, most = simd.splat(float32(0)), simd.splat(weight)
    apart = simd.maximum(differences, zero - differences)
    share = simd.minimum(apart * steep, simd.splat(float32(1)))
    slopes = simd.maximum(simd.minimum(differences * (steep * weight), most), zero - most)
    return share * (apart - share * half), slopes


@inline
def _blur(flat, at, step):
    """Return the windowed mean of 16 values from ``at`` on and their neighbours, ``step`` apart.

    Written out, the constants become part of the code, and mirrored taps share a product.
    """
    centre = simd.load(flat, at) * _W5
    one = (simd.load(flat, at - step) + simd.load(flat, at + step)) * _W4
    two = (simd.load(flat, at - 2 * step) + simd.load(flat, at + 2 * step)) * _W3
    three = (simd.load(flat, at - 3 * step) + simd.load(flat, at + 3 * step)) * _W2
    four = (simd.load(flat, at - 4 * step) + simd.load(flat, at + 4 * step)) * _W1
    five = (simd.load(flat, at - 5 * step) + simd.load(flat, at + 5 * step)) * _W0
    return (centre + one) + (two + three) + (four + five)


@parallel
def find_differences(drawn, target, height, width, differs):
    """Write which blocks of 16 x 16 pixels hold one that is not the same in both planes.

    Args:
        differs: (rows of blocks, columns of blocks) bool out.
    """
    rows, stride = drawn.shape[1], drawn.shape[2]
    x_flat, y_flat = drawn.reshape(-1), target.reshape(-1)
    for block_y in prange(differs.shape[0]):
        top, bottom = block_y * _BLOCK, min(block_y * _BLOCK + _BLOCK, height)
        for x in range(0, width, _LANES):
            inside, most = simd.first_lanes(width - x), simd.splat(float32(0))
            for channel in range(3):
                for y in range(top, bottom):
                    at = (channel * rows + y) * stride + x
                    apart = simd.load(x_flat, at) - simd.load(y_flat, at)
                    most = simd.maximum(most, simd.maximum(apart, simd.splat(float32(0)) - apart))
            differs[block_y, x // _LANES] = simd.reduce_max(most * inside) > float32(0)


@serial
def where_needed(differs, strips):
    """Return (strips, columns of blocks) uint8: what is done with 16 columns of a strip of rows.

    A window is less than a block wide, so SSIM is other than 1 only in blocks that differ and those
    beside them. To the gradient there, all other places add nothing: their derivatives cancel, and
    are read as zeros.
    """
    rows, columns = differs.shape
    needed = np.full((strips, columns), _UNREAD, np.uint8)
    for y in range(rows):
        for x in range(columns):
            if differs[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].any():
                needed[y * _BLOCK // STRIP, x] = _NEEDED
    for y in range(strips):
        for x in range(columns):
            if needed[y, x] == _UNREAD:
                around = needed[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
                if (around == _NEEDED).any():
                    needed[y, x] = _ZEROS
    return needed


@inline
def _is_read(needed, strip, column):
    """Return whether a window of the strip reaches into 16 columns."""
    beside = column > 0 and needed[strip, column - 1] == _NEEDED
    if column + 1 < needed.shape[1]:
        beside = beside or needed[strip, column + 1] == _NEEDED
    return beside or needed[strip, column] == _NEEDED


@inline
def _clear_outside(across, layers, layer, stride, top, bottom, height):
    """Set the sums of rows that are outside of the picture to 0."""
    for y in range(top - _REACH, bottom + _REACH):
        if y < 0 or y >= height:
            o = (y - top + _REACH) * stride
            for m in range(layers):
                across[m * layer + o : m * layer + o + stride] = float32(0)


@parallel
def ssim_maps(drawn, target, height, width, needed, maps, sums):
    """Write the partial derivatives of SSIM's sum that its gradient is convolved from.

    Args:
        needed: see ``where_needed``.
        maps: (3, 3, H', W') out: derivatives by the windowed mean of x, of x x and of x y.
        sums: (3 * strips,) float64 out, shares of the sum of SSIM over pixels and channels.
    """
    rows, stride = drawn.shape[1], drawn.shape[2]
    strips = (height + STRIP - 1) // STRIP
    x_flat, y_flat, out = drawn.reshape(-1), target.reshape(-1), maps.reshape(-1)
    size, pitch = 3 * rows * stride, stride + 2 * _MARGIN
    for task in prange(3 * strips):
        channel, strip = task // strips, task % strips
        top = strip * STRIP
        bottom = min(top + STRIP, height)
        # one row of x, y, x x + y y and x y with a margin of zeros; only the sum of the squares
        # matters, since the variances enter SSIM as a sum
        row = np.zeros(4 * pitch, np.float32)
        layer = (STRIP + 2 * _REACH) * stride
        across = np.empty(4 * layer, np.float32)
        _clear_outside(across, 4, layer, stride, top, bottom, height)
        zero, one, two = simd.splat(float32(0)), simd.splat(float32(1)), float32(2)
        for y in range(max(top - _REACH, 0), min(bottom + _REACH, height)):
            at = (channel * rows + y) * stride
            for x in range(0, width, _LANES):
                if not _is_read(needed, strip, x // _LANES):
                    continue
                inside = simd.first_lanes(width - x)
                a, b = simd.load(x_flat, at + x) * inside, simd.load(y_flat, at + x) * inside
                simd.store(row, _MARGIN + x, a)
                simd.store(row, pitch + _MARGIN + x, b)
                simd.store(row, 2 * pitch + _MARGIN + x, a * a + b * b)
                simd.store(row, 3 * pitch + _MARGIN + x, a * b)
            o = (y - top + _REACH) * stride
            for x in range(0, width, _LANES):
                if needed[strip, x // _LANES] == _NEEDED:
                    for m in range(4):
                        blurred = _blur(row, m * pitch + _MARGIN + x, 1)
                        simd.store(across, m * layer + o + x, blurred)
        total, alike = zero, 0
        for x in range(0, width, _LANES):
            state, inside = needed[strip, x // _LANES], simd.first_lanes(width - x)
            if state != _NEEDED:
                alike += min(width - x, _LANES) * (bottom - top)
                if state == _ZEROS:
                    for y in range(top, bottom):
                        o = (channel * rows + y) * stride + x
                        for m in range(3):
                            simd.store(out, m * size + o, zero)
                continue
            for y in range(top, bottom):
                o = (y - top + _REACH) * stride + x
                mx, my = _blur(across, o, stride), _blur(across, o + layer, stride)
                squares = _blur(across, o + 2 * layer, stride)
                mxy = _blur(across, o + 3 * layer, stride)
                cross, square = mx * my, mx * mx + my * my
                c1, c2 = simd.splat(_C1), simd.splat(_C2)
                inverse1, inverse = one / (square + c1), one / (squares - square + c2)
                luminance = (cross * two + c1) * inverse1
                structure = ((mxy - cross) * two + c2) * inverse
                value = luminance * structure
                by_xx = zero - value * inverse
                by_xy = luminance * inverse * two
                by_x = (my - mx * luminance) * structure * two * inverse1
                by_x = by_x - mx * by_xx * two - my * by_xy
                total = total + value * inside
                o = (channel * rows + y) * stride + x
                simd.store(out, o, by_x * inside)
                simd.store(out, size + o, by_xx * inside)
                simd.store(out, 2 * size + o, by_xy * inside)
        sums[task] = simd.reduce_sum(total) + alike


@parallel
def ssim_gradient(drawn, target, height, width, needed, maps, weight, gradient):
    """Add weight * d(sum of SSIM)/d(drawn) to ``gradient``, from the maps of ``ssim_maps``."""
    rows, stride = drawn.shape[1], drawn.shape[2]
    strips = (height + STRIP - 1) // STRIP
    x_flat, y_flat, m_flat = drawn.reshape(-1), target.reshape(-1), maps.reshape(-1)
    out, size, pitch = gradient.reshape(-1), 3 * rows * stride, stride + 2 * _MARGIN
    for task in prange(3 * strips):
        channel, strip = task // strips, task % strips
        top = strip * STRIP
        bottom = min(top + STRIP, height)
        row = np.zeros(3 * pitch, np.float32)
        layer = (STRIP + 2 * _REACH) * stride
        across = np.empty(3 * layer, np.float32)
        _clear_outside(across, 3, layer, stride, top, bottom, height)
        two = float32(2)
        for y in range(max(top - _REACH, 0), min(bottom + _REACH, height)):
            at = (channel * rows + y) * stride
            o = (y - top + _REACH) * stride
            # the maps are 0 beyond the picture's width, as far as they were written
            for x in range(0, width, _LANES):
                if _is_read(needed, strip, x // _LANES):
                    for m in range(3):
                        derivative = simd.load(m_flat, m * size + at + x)
                        simd.store(row, m * pitch + _MARGIN + x, derivative)
            for x in range(0, width, _LANES):
                if needed[strip, x // _LANES] == _NEEDED:
                    for m in range(3):
                        blurred = _blur(row, m * pitch + _MARGIN + x, 1)
                        simd.store(across, m * layer + o + x, blurred)
        for x in range(0, width, _LANES):
            if needed[strip, x // _LANES] != _NEEDED:
                continue
            for y in range(top, bottom):
                o = (y - top + _REACH) * stride + x
                a, b = _blur(across, o, stride), _blur(across, o + layer, stride)
                c = _blur(across, o + 2 * layer, stride)
                o = (channel * rows + y) * stride + x
                d = a + simd.load(x_flat, o) * b * two + simd.load(y_flat, o) * c
                d = d * weight * simd.first_lanes(width - x)
                simd.store(out, o, simd.load(out, o) + d)


@serial
def compare(drawn, target, height, width, ssim_weight, bend, gradient):
    """Return the loss of a ``Measure``, and write its gradient; arguments as in ``distance``.

    Args:
        bend: see ``Measure.bend``.
    """
    count = 3 * height * width
    sums = np.empty(3 * drawn.shape[1])
    steep, half, unit = bend
    weight = (1 - ssim_weight) * unit / count
    distance(
        drawn, target, height, width, float32(weight), float32(steep), float32(half), gradient, sums
    )
    loss = weight * sums.sum()
    if ssim_weight > 0:
        wanted = np.empty_like(drawn)
        to_float(target, wanted)
        blocks = (height + _BLOCK - 1) // _BLOCK, (width + _BLOCK - 1) // _BLOCK
        differs, strips = np.empty(blocks, np.bool_), (height + STRIP - 1) // STRIP
        find_differences(drawn, wanted, height, width, differs)
        needed = where_needed(differs, strips)
        maps = np.empty((3, 3, drawn.shape[1], drawn.shape[2]), np.float32)
        shares = np.empty(3 * strips)
        ssim_maps(drawn, wanted, height, width, needed, maps, shares)
        loss += ssim_weight * (1 - shares.sum() / count)
        factor = float32(-ssim_weight / count)
        ssim_gradient(drawn, wanted, height, width, needed, maps, factor, gradient)
    return loss
