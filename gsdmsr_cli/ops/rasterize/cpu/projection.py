"""Projects splats to the screen: EWA splatting (Zwicker et al. 2001, as in 3DGS) and back.

Notation: W rotates the world to the camera, M = R(q) diag(s) or the given axes A, J is the
projection's Jacobian at the centre. The two rows of J W M are ``g`` and ``h``; the screen
covariance is [[g.g + d, g.h], [g.h, h.h + d]] with the dilation d, and the conic is its inverse.

Numba compiles a form of its own for ``axes`` that are None, and one for an array of them, each
without the branches of the other.
"""

from __future__ import annotations

import math

from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel
from gsdmsr_cli.backends.cpu.rotation import rotation, rotation_backward
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN, DILATION, FRUSTUM_MARGIN, NEAR, TILE

_NEAR = float32(NEAR)
_DILATION = float32(DILATION)
_ALPHA_MIN = float32(ALPHA_MIN)
_MARGIN = float32(0.5 * FRUSTUM_MARGIN)
_TILE = TILE
ROUNDING = 2e-3
"""Widening of a splat's box [px] that covers float32 rounding of its edge."""
_ROUNDING = float32(ROUNDING)
_TINY = float32(1e-24)
_ZERO = float32(0)
_ONE = float32(1)
_LARGEST = float32(3e38)
_LARGEST_DET = float32(1e36)
_TWO = float32(2)


@inline
def _normalised(quats, i):
    a, b, c, d = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    n = _ONE / math.sqrt(max(a * a + b * b + c * c + d * d, _TINY))
    return a * n, b * n, c * n, d * n, n


@inline
def _clamped(u, limit):
    """Return u held to [-limit, limit], and 1 if it was inside, 0 if not."""
    if u > limit:
        return limit, float32(0)
    if u < -limit:
        return -limit, float32(0)
    return u, _ONE


@inline
def pixel_range(centre, half, size):
    """Return the first and last pixel of [0, size) whose centre is within ``half`` of ``centre``.

    The range is empty (last < first) where there is none. Positions are clamped before they become
    integers, since splats can be astronomically far off the screen.
    """
    low = centre - half - float32(0.5) - _ROUNDING
    high = centre + half - float32(0.5) + _ROUNDING
    first = math.ceil(min(max(low, float32(0)), float32(size)))
    last = math.floor(min(max(high, float32(-1)), float32(size - 1)))
    return first, last


@inline
def _finite(means, quats, log_scales, logit_opacities, sh, axes, i):
    total = logit_opacities[i]
    if axes is None:
        for k in range(3):
            total += means[i, k] + log_scales[i, k]
        for k in range(4):
            total += quats[i, k]
    else:
        for k in range(3):
            total += means[i, k] + axes[i, k, 0] + axes[i, k, 1] + axes[i, k, 2]
    for k in range(sh.shape[1]):
        total += sh[i, k, 0] + sh[i, k, 1] + sh[i, k, 2]
    return abs(total) <= _LARGEST


@inline
def _times_axes(w0, w1, w2, axes, i):
    """Return the row (w0, w1, w2) times the matrix of splat i."""
    return (
        w0 * axes[i, 0, 0] + w1 * axes[i, 1, 0] + w2 * axes[i, 2, 0],
        w0 * axes[i, 0, 1] + w1 * axes[i, 1, 1] + w2 * axes[i, 2, 1],
        w0 * axes[i, 0, 2] + w1 * axes[i, 1, 2] + w2 * axes[i, 2, 2],
    )


@parallel
def project(
    means, quats, log_scales, logit_opacities, sh, axes, view, intrinsics, width, height,
    means2d, conics, depths, opacities, radii, tiles,
):  # fmt: skip
    """Project N splats.

    Args:
        means, quats, log_scales, logit_opacities, sh: the stored splats, float32.
        axes: (N, 3, 3) float32, or None. Where they are given, quats and log_scales are not read.
        view: (3, 4) float32 world-to-camera rotation and translation.
        intrinsics: (4,) float32 fx, fy, cx, cy [px].
        width, height: picture size [px].
        means2d: (N, 2) out, centres [px].
        conics: (N, 3) out, a, b, c of the form a x^2 + 2 b x y + c y^2.
        depths: (N,) out, camera z.
        opacities: (N,) out, in (0, 1); 0 where the splat is not drawn.
        radii: (N,) out, half extent [px]; 0 where the splat is not drawn.
        tiles: (N,) int32 out, how many tiles the splat's box touches.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    limit_x, limit_y = _MARGIN * float32(width) / fx, _MARGIN * float32(height) / fy
    r00, r01, r02, t0 = view[0, 0], view[0, 1], view[0, 2], view[0, 3]
    r10, r11, r12, t1 = view[1, 0], view[1, 1], view[1, 2], view[1, 3]
    r20, r21, r22, t2 = view[2, 0], view[2, 1], view[2, 2], view[2, 3]
    for i in prange(means.shape[0]):
        opacities[i] = float32(0)
        radii[i] = float32(0)
        tiles[i] = 0
        depths[i] = float32(0)
        means2d[i, 0] = float32(0)
        means2d[i, 1] = float32(0)
        for k in range(3):
            conics[i, k] = float32(0)
        if not _finite(means, quats, log_scales, logit_opacities, sh, axes, i):
            continue
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        depth = r20 * x + r21 * y + r22 * z + t2
        opacity = _ONE / (_ONE + math.exp(-logit_opacities[i]))
        if depth <= _NEAR or opacity < _ALPHA_MIN:
            continue
        inverse_z = _ONE / depth
        u = (r00 * x + r01 * y + r02 * z + t0) * inverse_z
        v = (r10 * x + r11 * y + r12 * z + t1) * inverse_z
        px, py = fx * u + cx, fy * v + cy
        u, _ = _clamped(u, limit_x)
        v, _ = _clamped(v, limit_y)
        fxz, fyz = fx * inverse_z, fy * inverse_z
        w00, w01, w02 = fxz * (r00 - u * r20), fxz * (r01 - u * r21), fxz * (r02 - u * r22)
        w10, w11, w12 = fyz * (r10 - v * r20), fyz * (r11 - v * r21), fyz * (r12 - v * r22)
        if axes is None:
            a, b, c, d, _ = _normalised(quats, i)
            k00, k01, k02, k10, k11, k12, k20, k21, k22 = rotation(a, b, c, d)
            s0, s1, s2 = (
                math.exp(log_scales[i, 0]),
                math.exp(log_scales[i, 1]),
                math.exp(log_scales[i, 2]),
            )
            g0 = (w00 * k00 + w01 * k10 + w02 * k20) * s0
            h0 = (w10 * k00 + w11 * k10 + w12 * k20) * s0
            g1 = (w00 * k01 + w01 * k11 + w02 * k21) * s1
            h1 = (w10 * k01 + w11 * k11 + w12 * k21) * s1
            g2 = (w00 * k02 + w01 * k12 + w02 * k22) * s2
            h2 = (w10 * k02 + w11 * k12 + w12 * k22) * s2
        else:
            g0, g1, g2 = _times_axes(w00, w01, w02, axes, i)
            h0, h1, h2 = _times_axes(w10, w11, w12, axes, i)
        gg, hh = g0 * g0 + g1 * g1 + g2 * g2, h0 * h0 + h1 * h1 + h2 * h2
        gh = g0 * h0 + g1 * h1 + g2 * h2
        # |g x h|^2 in place of gg hh - gh^2, which cancels for needles in float32
        n0, n1, n2 = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
        area = n0 * n0 + n1 * n1 + n2 * n2
        det = area + _DILATION * (gg + hh) + _DILATION * _DILATION
        if not (det <= _LARGEST_DET and abs(px) <= _LARGEST and abs(py) <= _LARGEST):
            continue
        xx, yy = gg + _DILATION, hh + _DILATION
        extent = _TWO * math.log(opacity / _ALPHA_MIN)
        half_x, half_y = math.sqrt(extent * xx), math.sqrt(extent * yy)
        left, right = pixel_range(px, half_x, width)
        top, bottom = pixel_range(py, half_y, height)
        if right < left or bottom < top:
            continue
        inverse = _ONE / det
        means2d[i, 0], means2d[i, 1] = px, py
        conics[i, 0], conics[i, 1], conics[i, 2] = yy * inverse, -gh * inverse, xx * inverse
        depths[i] = depth
        opacities[i] = opacity
        radii[i] = max(half_x, half_y)
        tiles[i] = (right // _TILE - left // _TILE + 1) * (bottom // _TILE - top // _TILE + 1)


@parallel
def project_backward(
    means, quats, log_scales, axes, view, intrinsics, width, height, conics, opacities,
    d_means2d, d_conics, d_depths, d_opacities,
    d_means, d_quats, d_log_scales, d_logit_opacities, d_axes,
):  # fmt: skip
    """Write the gradients of the stored splats, given those of the projected ones.

    Splats that were not drawn (opacity 0) get zero. Arguments as in ``project``; every ``d_``
    argument has the shape of what it is the gradient of. ``d_axes`` is None where ``axes`` are;
    gradients of what is not read are not written.
    """
    fx, fy = intrinsics[0], intrinsics[1]
    limit_x, limit_y = _MARGIN * float32(width) / fx, _MARGIN * float32(height) / fy
    r00, r01, r02, t0 = view[0, 0], view[0, 1], view[0, 2], view[0, 3]
    r10, r11, r12, t1 = view[1, 0], view[1, 1], view[1, 2], view[1, 3]
    r20, r21, r22, t2 = view[2, 0], view[2, 1], view[2, 2], view[2, 3]
    for i in prange(means.shape[0]):
        opacity = opacities[i]
        d_logit_opacities[i] = d_opacities[i] * opacity * (_ONE - opacity)
        if opacity == float32(0):
            for k in range(3):
                d_means[i, k] = float32(0)
            if axes is None:
                for k in range(3):
                    d_log_scales[i, k] = float32(0)
                for k in range(4):
                    d_quats[i, k] = float32(0)
            else:
                for k in range(3):
                    d_axes[i, k, 0], d_axes[i, k, 1], d_axes[i, k, 2] = _ZERO, _ZERO, _ZERO
            continue
        x, y, z = means[i, 0], means[i, 1], means[i, 2]
        inverse_z = _ONE / (r20 * x + r21 * y + r22 * z + t2)
        u_free = (r00 * x + r01 * y + r02 * z + t0) * inverse_z
        v_free = (r10 * x + r11 * y + r12 * z + t1) * inverse_z
        u, u_inside = _clamped(u_free, limit_x)
        v, v_inside = _clamped(v_free, limit_y)
        fxz, fyz = fx * inverse_z, fy * inverse_z
        w00, w01, w02 = fxz * (r00 - u * r20), fxz * (r01 - u * r21), fxz * (r02 - u * r22)
        w10, w11, w12 = fyz * (r10 - v * r20), fyz * (r11 - v * r21), fyz * (r12 - v * r22)
        if axes is None:
            a, b, c, d, n = _normalised(quats, i)
            k00, k01, k02, k10, k11, k12, k20, k21, k22 = rotation(a, b, c, d)
            s0, s1, s2 = (
                math.exp(log_scales[i, 0]),
                math.exp(log_scales[i, 1]),
                math.exp(log_scales[i, 2]),
            )
            m00, m10, m20 = k00 * s0, k10 * s0, k20 * s0
            m01, m11, m21 = k01 * s1, k11 * s1, k21 * s1
            m02, m12, m22 = k02 * s2, k12 * s2, k22 * s2
        else:
            m00, m01, m02 = axes[i, 0, 0], axes[i, 0, 1], axes[i, 0, 2]
            m10, m11, m12 = axes[i, 1, 0], axes[i, 1, 1], axes[i, 1, 2]
            m20, m21, m22 = axes[i, 2, 0], axes[i, 2, 1], axes[i, 2, 2]
        g0, h0 = w00 * m00 + w01 * m10 + w02 * m20, w10 * m00 + w11 * m10 + w12 * m20
        g1, h1 = w00 * m01 + w01 * m11 + w02 * m21, w10 * m01 + w11 * m11 + w12 * m21
        g2, h2 = w00 * m02 + w01 * m12 + w02 * m22, w10 * m02 + w11 * m12 + w12 * m22
        # screen covariance S = K^-1, so dL/dS = -K G K, where G holds dL/dK with b split in half
        ca, cb, cc = conics[i, 0], conics[i, 1], conics[i, 2]
        ga, gb, gc = d_conics[i, 0], float32(0.5) * d_conics[i, 1], d_conics[i, 2]
        p00, p01 = ca * ga + cb * gb, ca * gb + cb * gc
        p10, p11 = cb * ga + cc * gb, cb * gb + cc * gc
        s_xx = -(p00 * ca + p01 * cb)
        s_xy = -(p00 * cb + p01 * cc)
        s_yy = -(p10 * cb + p11 * cc)
        dg0, dh0 = _TWO * (s_xx * g0 + s_xy * h0), _TWO * (s_xy * g0 + s_yy * h0)
        dg1, dh1 = _TWO * (s_xx * g1 + s_xy * h1), _TWO * (s_xy * g1 + s_yy * h1)
        dg2, dh2 = _TWO * (s_xx * g2 + s_xy * h2), _TWO * (s_xy * g2 + s_yy * h2)
        # dL/dM = W^T [dg; dh]
        d00, d10, d20 = w00 * dg0 + w10 * dh0, w01 * dg0 + w11 * dh0, w02 * dg0 + w12 * dh0
        d01, d11, d21 = w00 * dg1 + w10 * dh1, w01 * dg1 + w11 * dh1, w02 * dg1 + w12 * dh1
        d02, d12, d22 = w00 * dg2 + w10 * dh2, w01 * dg2 + w11 * dh2, w02 * dg2 + w12 * dh2
        if axes is None:
            # its product with M's columns is the gradient of the log scales
            d_log_scales[i, 0] = d00 * m00 + d10 * m10 + d20 * m20
            d_log_scales[i, 1] = d01 * m01 + d11 * m11 + d21 * m21
            d_log_scales[i, 2] = d02 * m02 + d12 * m12 + d22 * m22
            d00, d10, d20 = d00 * s0, d10 * s0, d20 * s0
            d01, d11, d21 = d01 * s1, d11 * s1, d21 * s1
            d02, d12, d22 = d02 * s2, d12 * s2, d22 * s2
            qa, qb, qc, qd = rotation_backward(
                a, b, c, d, d00, d01, d02, d10, d11, d12, d20, d21, d22
            )
            along = qa * a + qb * b + qc * c + qd * d
            d_quats[i, 0], d_quats[i, 1] = (qa - along * a) * n, (qb - along * b) * n
            d_quats[i, 2], d_quats[i, 3] = (qc - along * c) * n, (qd - along * d) * n
        else:
            d_axes[i, 0, 0], d_axes[i, 0, 1], d_axes[i, 0, 2] = d00, d01, d02
            d_axes[i, 1, 0], d_axes[i, 1, 1], d_axes[i, 1, 2] = d10, d11, d12
            d_axes[i, 2, 0], d_axes[i, 2, 1], d_axes[i, 2, 2] = d20, d21, d22
        # dL/dW rows, then through W = f/z (R0 - u R2) and the projection of the centre
        e00, e01, e02 = (
            dg0 * m00 + dg1 * m01 + dg2 * m02,
            dg0 * m10 + dg1 * m11 + dg2 * m12,
            dg0 * m20 + dg1 * m21 + dg2 * m22,
        )
        e10, e11, e12 = (
            dh0 * m00 + dh1 * m01 + dh2 * m02,
            dh0 * m10 + dh1 * m11 + dh2 * m12,
            dh0 * m20 + dh1 * m21 + dh2 * m22,
        )
        du = d_means2d[i, 0] * fx - u_inside * fxz * (e00 * r20 + e01 * r21 + e02 * r22)
        dv = d_means2d[i, 1] * fy - v_inside * fyz * (e10 * r20 + e11 * r21 + e12 * r22)
        through_focal = e00 * w00 + e01 * w01 + e02 * w02 + e10 * w10 + e11 * w11 + e12 * w12
        dz = d_depths[i] - inverse_z * (through_focal + du * u_free + dv * v_free)
        dx, dy = du * inverse_z, dv * inverse_z
        d_means[i, 0] = r00 * dx + r10 * dy + r20 * dz
        d_means[i, 1] = r01 * dx + r11 * dy + r21 * dz
        d_means[i, 2] = r02 * dx + r12 * dy + r22 * dz
