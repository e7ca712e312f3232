"""Colours of splats that have turned, in one pass over what is stored."""

from __future__ import annotations

import math

from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel

_SHORTEST = float32(1e-24)
"""Least squared norm of a quaternion that says how something has turned."""


@inline
def _turn(quats, before, i):
    """Return twice the vector part of the unit quaternion from one rotation to the other."""
    a, b, c, d = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    e, f, g, h = before[i, 0], before[i, 1], before[i, 2], before[i, 3]
    w = a * e + b * f + c * g + d * h
    x = b * e - a * f + d * g - c * h
    y = c * e - a * g + b * h - d * f
    z = d * e - a * h + c * f - b * g
    norm2 = max(w * w + x * x + y * y + z * z, _SHORTEST)
    factor = math.copysign(float32(2), w) / math.sqrt(norm2)
    return factor * x, factor * y, factor * z


@parallel
def light(sh, slopes, quats, before, turns, lit):
    """Write the harmonics of N splats.

    Args:
        sh: (N, K, 3).
        slopes: (N, 3, 3), axis and channel.
        quats, before: (N, 4).
        turns: (N, 3) out, what slopes are multiplied by.
        lit: (N, K, 3) out.
    """
    for i in prange(sh.shape[0]):
        x, y, z = _turn(quats, before, i)
        turns[i, 0], turns[i, 1], turns[i, 2] = x, y, z
        for k in range(sh.shape[1]):
            for c in range(3):
                lit[i, k, c] = sh[i, k, c]
        for c in range(3):
            lit[i, 0, c] += x * slopes[i, 0, c] + y * slopes[i, 1, c] + z * slopes[i, 2, c]


@parallel
def light_backward(turns, d_lit, d_slopes):
    """Write the gradient of slopes (N, 3, 3), 0 where nothing is to be learnt."""
    zero = float32(0)
    for i in prange(turns.shape[0]):
        for k in range(3):
            for c in range(3):
                given = d_lit[i, 0, c]
                d_slopes[i, k, c] = turns[i, k] * given if given != zero else zero
