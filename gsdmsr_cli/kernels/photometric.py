"""L1 and SSIM of a drawn picture against an 8-bit target, with their gradients.

SSIM is that of 3DGS: an 11 x 11 Gaussian window of sigma 1.5, zero padding, averaged over pixels
and channels (Wang et al. 2004). Pictures are planes (3, H', W') whose width is a multiple of 16 and
whose part beyond H x W does not count.
"""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.kernels import simd
from gsdmsr_cli.kernels.jit import inline, parallel

STRIP = 16
"""Rows that one task handles at a time; its horizontal sums stay in cache."""

_LANES = simd.LANES
_REACH = 5
_TAPS = 2 * _REACH + 1
_C1, _C2 = float32(0.01**2), float32(0.03**2)
_MARGIN = _LANES
_WINDOW = np.exp(-0.5 * (np.arange(_TAPS) - _REACH) ** 2 / 1.5**2)
WINDOW = (_WINDOW / _WINDOW.sum()).astype(np.float32)
_SCALE = float32(1 / 255)


@parallel
def to_float(target, planes):
    """Write an 8-bit target (3, H, W) as planes (3, H', W') in [0, 1], 0 outside the picture."""
    channels, height, width = target.shape
    for task in prange(channels * planes.shape[1]):
        channel, y = task // planes.shape[1], task % planes.shape[1]
        if y >= height:
            planes[channel, y] = float32(0)
            continue
        for x in range(width):
            planes[channel, y, x] = float32(target[channel, y, x]) * _SCALE
        for x in range(width, planes.shape[2]):
            planes[channel, y, x] = float32(0)


@parallel
def l1(drawn, target, height, width, weight, gradient, sums):
    """Write weight * sign(drawn - target), 0 outside the picture, and sums of |differences|.

    Args:
        drawn, gradient: planes (3, H', W').
        target: (3, H, W) uint8.
        sums: (3 * H',) out.
    """
    rows, stride = drawn.shape[1], drawn.shape[2]
    for task in prange(3 * rows):
        channel, y = task // rows, task % rows
        total = float32(0)
        inside = width if y < height else 0
        for x in range(inside):
            difference = drawn[channel, y, x] - float32(target[channel, y, x]) * _SCALE
            total += abs(difference)
            sign = float32(difference > 0) - float32(difference < 0)
            gradient[channel, y, x] = weight * sign
        for x in range(inside, stride):
            gradient[channel, y, x] = float32(0)
        sums[task] = total


@inline
def _inside(x, width):
    """Return the vector that is 1 in the lanes of columns below ``width``, else 0."""
    return simd.where_ge(
        simd.splat(float32(width) - float32(0.5)), simd.iota(float32(x)), simd.splat(float32(1))
    )


@inline
def _copy_row(flat, at, width, row):
    """Copy ``width`` columns to ``row`` behind its margin, which stays 0."""
    for x in range(width):
        row[_MARGIN + x] = flat[at + x]


@parallel
def ssim_maps(drawn, target, height, width, maps, sums):
    """Write the partial derivatives of SSIM's sum that its gradient is convolved from.

    Args:
        maps: (3, 3, H', W') out: derivatives by the windowed mean of x, of x x and of x y.
        sums: (3 * strips,) float64 out, shares of the sum of SSIM over pixels and channels.
    """
    rows, stride = drawn.shape[1], drawn.shape[2]
    strips = (height + STRIP - 1) // STRIP
    x_flat, y_flat, out = drawn.reshape(-1), target.reshape(-1), maps.reshape(-1)
    size = 3 * rows * stride
    for task in prange(3 * strips):
        channel, top = task // strips, task % strips * STRIP
        bottom = min(top + STRIP, height)
        x_row = np.zeros(stride + 2 * _MARGIN, np.float32)
        y_row = np.zeros(stride + 2 * _MARGIN, np.float32)
        layer = (STRIP + 2 * _REACH) * stride
        across = np.zeros(5 * layer, np.float32)
        zero, two = simd.splat(float32(0)), float32(2)
        for y in range(max(top - _REACH, 0), min(bottom + _REACH, height)):
            at = (channel * rows + y) * stride
            _copy_row(x_flat, at, width, x_row)
            _copy_row(y_flat, at, width, y_row)
            for x in range(0, width, _LANES):
                mx, my, mxx, myy, mxy = zero, zero, zero, zero, zero
                for k in range(_TAPS):
                    a = simd.load(x_row, x + _MARGIN - _REACH + k)
                    b = simd.load(y_row, x + _MARGIN - _REACH + k)
                    wa, wb = a * WINDOW[k], b * WINDOW[k]
                    mx, my = mx + wa, my + wb
                    mxx, myy, mxy = mxx + wa * a, myy + wb * b, mxy + wa * b
                o = (y - top + _REACH) * stride + x
                simd.store(across, o, mx)
                simd.store(across, o + layer, my)
                simd.store(across, o + 2 * layer, mxx)
                simd.store(across, o + 3 * layer, myy)
                simd.store(across, o + 4 * layer, mxy)
        total = zero
        for y in range(top, bottom):
            for x in range(0, width, _LANES):
                mx, my, mxx, myy, mxy = zero, zero, zero, zero, zero
                for k in range(_TAPS):
                    o = (y - top + k) * stride + x
                    mx = mx + simd.load(across, o) * WINDOW[k]
                    my = my + simd.load(across, o + layer) * WINDOW[k]
                    mxx = mxx + simd.load(across, o + 2 * layer) * WINDOW[k]
                    myy = myy + simd.load(across, o + 3 * layer) * WINDOW[k]
                    mxy = mxy + simd.load(across, o + 4 * layer) * WINDOW[k]
                cross, square = mx * my, mx * mx + my * my
                c1, c2 = simd.splat(_C1), simd.splat(_C2)
                luminance = (cross * two + c1) / (square + c1)
                inverse = simd.splat(float32(1)) / (mxx + myy - square + c2)
                structure = ((mxy - cross) * two + c2) * inverse
                value = luminance * structure
                by_xx = zero - value * inverse
                by_xy = luminance * inverse * two
                by_x = (my - mx * luminance) * structure * two / (square + c1)
                by_x = by_x - mx * by_xx * two - my * by_xy
                inside = _inside(x, width)
                total = total + value * inside
                o = (channel * rows + y) * stride + x
                simd.store(out, o, by_x * inside)
                simd.store(out, size + o, by_xx * inside)
                simd.store(out, 2 * size + o, by_xy * inside)
        sums[task] = simd.reduce_sum(total)


@parallel
def ssim_gradient(drawn, target, height, width, maps, weight, gradient):
    """Add weight * d(sum of SSIM)/d(drawn) to ``gradient``, from the maps of ``ssim_maps``."""
    rows, stride = drawn.shape[1], drawn.shape[2]
    strips = (height + STRIP - 1) // STRIP
    x_flat, y_flat, m_flat = drawn.reshape(-1), target.reshape(-1), maps.reshape(-1)
    out, size = gradient.reshape(-1), 3 * rows * stride
    for task in prange(3 * strips):
        channel, top = task // strips, task % strips * STRIP
        bottom = min(top + STRIP, height)
        padded = np.zeros(3 * (stride + 2 * _MARGIN), np.float32)
        pitch = stride + 2 * _MARGIN
        layer = (STRIP + 2 * _REACH) * stride
        across = np.zeros(3 * layer, np.float32)
        zero, two = simd.splat(float32(0)), float32(2)
        for y in range(max(top - _REACH, 0), min(bottom + _REACH, height)):
            at = (channel * rows + y) * stride
            for m in range(3):
                _copy_row(m_flat, m * size + at, width, padded[m * pitch : (m + 1) * pitch])
            for x in range(0, width, _LANES):
                a, b, c = zero, zero, zero
                for k in range(_TAPS):
                    o = x + _MARGIN - _REACH + k
                    a = a + simd.load(padded, o) * WINDOW[k]
                    b = b + simd.load(padded, o + pitch) * WINDOW[k]
                    c = c + simd.load(padded, o + 2 * pitch) * WINDOW[k]
                o = (y - top + _REACH) * stride + x
                simd.store(across, o, a)
                simd.store(across, o + layer, b)
                simd.store(across, o + 2 * layer, c)
        for y in range(top, bottom):
            for x in range(0, width, _LANES):
                a, b, c = zero, zero, zero
                for k in range(_TAPS):
                    o = (y - top + k) * stride + x
                    a = a + simd.load(across, o) * WINDOW[k]
                    b = b + simd.load(across, o + layer) * WINDOW[k]
                    c = c + simd.load(across, o + 2 * layer) * WINDOW[k]
                o = (channel * rows + y) * stride + x
                d = a + simd.load(x_flat, o) * b * two + simd.load(y_flat, o) * c
                d = d * weight * _inside(x, width)
                simd.store(out, o, simd.load(out, o) + d)
