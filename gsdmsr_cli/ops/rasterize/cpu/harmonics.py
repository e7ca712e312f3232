"""Colour of splats from spherical harmonics of degree 0 to 3, and back (3DGS, appendix)."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
_C0, _C1 = float32(C0), float32(C1)
_C20, _C21, _C22 = (float32(c) for c in C2)
_C30, _C31, _C32, _C33, _C34 = (float32(c) for c in C3)
_HALF = float32(0.5)
_BLOCKS = 64


@inline
def _basis(x, y, z, count, out):
    """Write the first ``count`` basis functions at the unit direction (x, y, z)."""
    out[0] = _C0
    if count > 1:
        out[1], out[2], out[3] = -_C1 * y, _C1 * z, -_C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        out[4], out[5] = _C20 * x * y, -_C20 * y * z
        out[6] = _C21 * (float32(2) * zz - xx - yy)
        out[7], out[8] = -_C20 * x * z, _C22 * (xx - yy)
        if count > 9:
            out[9] = -_C30 * y * (float32(3) * xx - yy)
            out[10] = _C31 * x * y * z
            out[11] = -_C32 * y * (float32(4) * zz - xx - yy)
            out[12] = _C33 * z * (float32(2) * zz - float32(3) * xx - float32(3) * yy)
            out[13] = -_C32 * x * (float32(4) * zz - xx - yy)
            out[14] = _C34 * z * (xx - yy)
            out[15] = -_C30 * x * (xx - float32(3) * yy)


@inline
def _basis_slope(x, y, z, count, w):
    """Return the gradient in (x, y, z) of sum_k w[k] basis_k."""
    gx, gy, gz = float32(0), float32(0), float32(0)
    if count > 1:
        gx, gy, gz = -_C1 * w[3], -_C1 * w[1], _C1 * w[2]
    if count > 4:
        two = float32(2)
        gx += _C20 * (y * w[4] - z * w[7]) + two * x * (_C22 * w[8] - _C21 * w[6])
        gy += _C20 * (x * w[4] - z * w[5]) - two * y * (_C22 * w[8] + _C21 * w[6])
        gz += float32(4) * _C21 * z * w[6] - _C20 * (y * w[5] + x * w[7])
        if count > 9:
            xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
            three, six, eight = float32(3), float32(6), float32(8)
            gx += -_C30 * (six * xy * w[9] + three * (xx - yy) * w[15]) + _C31 * yz * w[10]
            gx += _C32 * (two * xy * w[11] - (float32(4) * zz - three * xx - yy) * w[13])
            gx += -six * _C33 * xz * w[12] + two * _C34 * xz * w[14]
            gy += -_C30 * (three * (xx - yy) * w[9] - six * xy * w[15]) + _C31 * xz * w[10]
            gy += _C32 * (-(float32(4) * zz - xx - three * yy) * w[11] + two * xy * w[13])
            gy += -six * _C33 * yz * w[12] - two * _C34 * yz * w[14]
            gz += _C31 * xy * w[10] - eight * _C32 * (yz * w[11] + xz * w[13])
            gz += _C33 * (six * zz - three * xx - three * yy) * w[12] + _C34 * (xx - yy) * w[14]
    return gx, gy, gz


@inline
def _direction(means, centre, i):
    x, y, z = means[i, 0] - centre[0], means[i, 1] - centre[1], means[i, 2] - centre[2]
    inverse = float32(1) / math.sqrt(max(x * x + y * y + z * z, float32(1e-24)))
    return x * inverse, y * inverse, z * inverse, inverse


@parallel
def colour(means, sh, count, centre, opacities, colours):
    """Write the (N, 3) colours max(0, 1/2 + sh . basis) of the drawn splats, 0 for the others.

    Args:
        means: (N, 3) float32. sh: (N, K, 3) float32, of which the first ``count`` are used.
        centre: (3,) float32 position of the camera in the world.
        opacities: (N,) float32, 0 where a splat is not drawn.
        colours: (N, 3) float32 out.
    """
    n = means.shape[0]
    for block in prange(_BLOCKS):
        basis = np.empty(16, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            for channel in range(3):
                colours[i, channel] = float32(0)
            if opacities[i] == float32(0):
                continue
            x, y, z, _ = _direction(means, centre, i)
            _basis(x, y, z, count, basis)
            red, green, blue = _HALF, _HALF, _HALF  # three sums at once wait less for each other
            for k in range(count):
                red += sh[i, k, 0] * basis[k]
                green += sh[i, k, 1] * basis[k]
                blue += sh[i, k, 2] * basis[k]
            colours[i, 0], colours[i, 1] = max(red, float32(0)), max(green, float32(0))
            colours[i, 2] = max(blue, float32(0))


@parallel
def colour_backward(means, sh, count, centre, opacities, colours, d_colours, d_means, d_sh):
    """Add to ``d_means`` and write ``d_sh``; a colour clamped at 0 passes nothing.

    Arguments as in ``colour``; every ``d_`` argument has the shape of what it is the gradient of.
    """
    n = means.shape[0]
    for block in prange(_BLOCKS):
        basis = np.empty(16, np.float32)
        weight = np.empty(16, np.float32)
        passed = np.empty(3, np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            for k in range(sh.shape[1]):
                for channel in range(3):
                    d_sh[i, k, channel] = float32(0)
            if opacities[i] == float32(0):
                continue
            x, y, z, inverse = _direction(means, centre, i)
            _basis(x, y, z, count, basis)
            for channel in range(3):
                passed[channel] = (
                    d_colours[i, channel] if colours[i, channel] > float32(0) else float32(0)
                )
            for k in range(count):
                weight[k] = float32(0)
                for channel in range(3):
                    d_sh[i, k, channel] = basis[k] * passed[channel]
                    weight[k] += sh[i, k, channel] * passed[channel]
            if count > 1:
                gx, gy, gz = _basis_slope(x, y, z, count, weight)
                along = gx * x + gy * y + gz * z
                d_means[i, 0] += (gx - along * x) * inverse
                d_means[i, 1] += (gy - along * y) * inverse
                d_means[i, 2] += (gz - along * z) * inverse
