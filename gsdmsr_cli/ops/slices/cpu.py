"""Slices of Gaussians in space and time on arrays, one after the other.

S is M M^T. The first row of M is that of time, t = (d b_0, -E^T b) with the duration d, the tilt
(b_0, b) and the scaled axes E of space; the others are the rows of P = (d b | K E) with
K = b_0 1 - [b]x. Then S_tt = t t, S_xt = P t, and the axes are P U, where the columns of U are u i,
u j and u k for the unit quaternion u = t / sqrt(S_tt).
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel
from gsdmsr_cli.backends.cpu.rotation import rotation, rotation_backward

LEAST_VARIANCE = 1e-12
"""Variances in time count as this at least."""

_BLOCKS = 16
_LEAST = float32(LEAST_VARIANCE)
_SHORTEST = float32(1e-12)
"""Quaternions count as this long at least."""

_ZERO, _HALF, _ONE, _TWO = float32(0), float32(0.5), float32(1), float32(2)


@inline
def _unit(q, i):
    """Return a quaternion in unit length, and the length that it had."""
    a, b, c, d = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
    norm = max(math.sqrt(a * a + b * b + c * c + d * d), _SHORTEST)
    return a / norm, b / norm, c / norm, d / norm, norm


@inline
def _lay_out(quats, log_scales, tilts, log_durations, i, e, b, t, p):
    """Write a Gaussian's axes E (3, 3), tilt (4,), and the rows of M: t (4,) and P (3, 4).

    Returns:
        the scales along its axes, and the duration.
    """
    u, v, w = (
        math.exp(log_scales[i, 0]),
        math.exp(log_scales[i, 1]),
        math.exp(log_scales[i, 2]),
    )
    qw, qx, qy, qz, _ = _unit(quats, i)
    m = rotation(qw, qx, qy, qz)
    for r in range(3):
        e[r, 0], e[r, 1], e[r, 2] = m[3 * r] * u, m[3 * r + 1] * v, m[3 * r + 2] * w
    b[0], b[1], b[2], b[3], _ = _unit(tilts, i)
    duration = math.exp(log_durations[i])
    t[0] = duration * b[0]
    for r in range(3):
        p[r, 0] = duration * b[1 + r]
    for c in range(3):
        x, y, z = e[0, c], e[1, c], e[2, c]
        t[1 + c] = -(b[1] * x + b[2] * y + b[3] * z)
        p[0, 1 + c] = b[0] * x + b[3] * y - b[2] * z
        p[1, 1 + c] = b[0] * y + b[1] * z - b[3] * x
        p[2, 1 + c] = b[0] * z + b[2] * x - b[1] * y
    return u, v, w, duration


@inline
def _measure(t):
    """Return the variance in time, which is at least what counts, and what it is."""
    found = t[0] * t[0] + t[1] * t[1] + t[2] * t[2] + t[3] * t[3]
    return max(found, _LEAST), found


@parallel
def cut(quats, log_scales, tilts, log_durations, variances, velocities, axes):
    """Write the slices of N Gaussians.

    Args:
        quats, log_scales, tilts, log_durations: (N, 4), (N, 3), (N, 4), (N,).
        variances, velocities, axes: (N,), (N, 3), (N, 3, 3) out.
    """
    n = quats.shape[0]
    for block in prange(_BLOCKS):
        e, b = np.empty((3, 3), np.float32), np.empty(4, np.float32)
        t, p = np.empty(4, np.float32), np.empty((3, 4), np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            _lay_out(quats, log_scales, tilts, log_durations, i, e, b, t, p)
            variance, _ = _measure(t)
            steep = _ONE / math.sqrt(variance)
            w, x, y, z = t[0] * steep, t[1] * steep, t[2] * steep, t[3] * steep
            variances[i] = variance
            for r in range(3):
                o, j, k, q = p[r, 0], p[r, 1], p[r, 2], p[r, 3]
                velocities[i, r] = (o * t[0] + j * t[1] + k * t[2] + q * t[3]) / variance
                axes[i, r, 0] = w * j - x * o + z * k - y * q
                axes[i, r, 1] = w * k - y * o + x * q - z * j
                axes[i, r, 2] = w * q - z * o + y * j - x * k


@inline
def _rows_backward(t, p, d_variance, d_velocity, d_axes, i, d_t, d_p):
    """Write the gradients of t and P, given those of a slice."""
    variance, found = _measure(t)
    inverse, steep = _ONE / variance, _ONE / math.sqrt(variance)
    w, x, y, z = t[0] * steep, t[1] * steep, t[2] * steep, t[3] * steep
    dw, dx, dy, dz = _ZERO, _ZERO, _ZERO, _ZERO
    slope = d_variance[i]
    for c in range(4):
        d_t[c] = _ZERO
    for r in range(3):
        o, j, k, q = p[r, 0], p[r, 1], p[r, 2], p[r, 3]
        f, g, h = d_axes[i, r, 0], d_axes[i, r, 1], d_axes[i, r, 2]
        given = d_velocity[i, r] * inverse
        d_p[r, 0] = given * t[0] - x * f - y * g - z * h
        d_p[r, 1] = given * t[1] + w * f - z * g + y * h
        d_p[r, 2] = given * t[2] + z * f + w * g - x * h
        d_p[r, 3] = given * t[3] - y * f + x * g + w * h
        dw += j * f + k * g + q * h
        dx += q * g - o * f - k * h
        dy += j * h - o * g - q * f
        dz += k * f - o * h - j * g
        d_t[0] += given * o
        d_t[1] += given * j
        d_t[2] += given * k
        d_t[3] += given * q
        slope -= given * (o * t[0] + j * t[1] + k * t[2] + q * t[3]) * inverse
    slope -= _HALF * inverse * (dw * w + dx * x + dy * y + dz * z)
    twice = _TWO * slope if found >= _LEAST else _ZERO
    d_t[0] += dw * steep + twice * t[0]
    d_t[1] += dx * steep + twice * t[1]
    d_t[2] += dy * steep + twice * t[2]
    d_t[3] += dz * steep + twice * t[3]


@inline
def _tilt_backward(e, b, duration, d_t, d_p, d_b, d_e):
    """Write the gradients of the tilt and of E; return that of the logarithm of the duration."""
    d_duration = d_t[0] * b[0]
    d_b[0] = d_t[0] * duration
    for r in range(3):
        d_duration += d_p[r, 0] * b[1 + r]
        d_b[1 + r] = d_p[r, 0] * duration
    for c in range(3):
        x, y, z = e[0, c], e[1, c], e[2, c]
        s, f, g, h = d_t[1 + c], d_p[0, 1 + c], d_p[1, 1 + c], d_p[2, 1 + c]
        d_b[0] += f * x + g * y + h * z
        d_b[1] += g * z - h * y - s * x
        d_b[2] += h * x - f * z - s * y
        d_b[3] += f * y - g * x - s * z
        d_e[0, c] = b[0] * f - b[3] * g + b[2] * h - b[1] * s
        d_e[1, c] = b[0] * g - b[1] * h + b[3] * f - b[2] * s
        d_e[2, c] = b[0] * h - b[2] * f + b[1] * g - b[3] * s
    return d_duration * duration


@inline
def _unit_backward(q, i, a, b, c, d, d_q):
    """Write the gradient of a quaternion, given that of its unit length."""
    w, x, y, z, norm = _unit(q, i)
    along = a * w + b * x + c * y + d * z if norm > _SHORTEST else _ZERO
    d_q[i, 0], d_q[i, 1] = (a - along * w) / norm, (b - along * x) / norm
    d_q[i, 2], d_q[i, 3] = (c - along * y) / norm, (d - along * z) / norm


@inline
def _is_live(d_variance, d_velocity, d_axes, i):
    """Return whether the gradient of a slice holds anything."""
    live = d_variance[i] != _ZERO
    for r in range(3):
        live |= d_velocity[i, r] != _ZERO
        for c in range(3):
            live |= d_axes[i, r, c] != _ZERO
    return live


@parallel
def cut_backward(
    quats, log_scales, tilts, log_durations, d_variances, d_velocities, d_axes,
    d_quats, d_log_scales, d_tilts, d_log_durations,
):  # fmt: skip
    """Write the gradients of ``cut``: of its arguments, given those of what it wrote."""
    n = quats.shape[0]
    for block in prange(_BLOCKS):
        e, b = np.empty((3, 3), np.float32), np.empty(4, np.float32)
        t, p = np.empty(4, np.float32), np.empty((3, 4), np.float32)
        d_e, d_b = np.empty((3, 3), np.float32), np.empty(4, np.float32)
        d_t, d_p = np.empty(4, np.float32), np.empty((3, 4), np.float32)
        for i in range(n * block // _BLOCKS, n * (block + 1) // _BLOCKS):
            if not _is_live(d_variances, d_velocities, d_axes, i):
                d_quats[i], d_log_scales[i], d_tilts[i] = _ZERO, _ZERO, _ZERO
                d_log_durations[i] = _ZERO
                continue
            u, v, w, duration = _lay_out(quats, log_scales, tilts, log_durations, i, e, b, t, p)
            _rows_backward(t, p, d_variances, d_velocities, d_axes, i, d_t, d_p)
            d_log_durations[i] = _tilt_backward(e, b, duration, d_t, d_p, d_b, d_e)
            _unit_backward(tilts, i, d_b[0], d_b[1], d_b[2], d_b[3], d_tilts)
            for c in range(3):
                d_log_scales[i, c] = d_e[0, c] * e[0, c] + d_e[1, c] * e[1, c] + d_e[2, c] * e[2, c]
            for r in range(3):
                d_e[r, 0], d_e[r, 1], d_e[r, 2] = d_e[r, 0] * u, d_e[r, 1] * v, d_e[r, 2] * w
            qw, qx, qy, qz, _ = _unit(quats, i)
            dw, dx, dy, dz = rotation_backward(
                qw, qx, qy, qz, d_e[0, 0], d_e[0, 1], d_e[0, 2],
                d_e[1, 0], d_e[1, 1], d_e[1, 2], d_e[2, 0], d_e[2, 1], d_e[2, 2],
            )  # fmt: skip
            _unit_backward(quats, i, dw, dx, dy, dz, d_quats)
