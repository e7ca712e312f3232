"""Adam with a multiplier per row and a true skip of rows (Kingma & Ba 2015)."""

from __future__ import annotations

import math

from numba import float32, prange

from gsdmsr_cli.kernels import simd
from gsdmsr_cli.kernels.jit import parallel

_BLOCKS = 64
_LANES = simd.LANES
_ONE = float32(1)


@parallel
def adam(values, gradients, first, second, rate, beta1, beta2, eps, correction1, correction2):
    """Update flat arrays in place: values, first and second moments.

    ``correction1`` and ``correction2`` are 1 - beta^step.
    """
    n = values.shape[0] // _LANES
    keep1, keep2 = _ONE - beta1, _ONE - beta2
    step, inverse2 = rate / correction1, _ONE / correction2
    for block in prange(_BLOCKS):
        low = simd.splat(eps)
        for o in range(n * block // _BLOCKS * _LANES, n * (block + 1) // _BLOCKS * _LANES, _LANES):
            gradient = simd.load(gradients, o)
            m = simd.load(first, o) * beta1 + gradient * keep1
            v = simd.load(second, o) * beta2 + gradient * gradient * keep2
            simd.store(first, o, m)
            simd.store(second, o, v)
            moved = m * step / (simd.sqrt(v * inverse2) + low)
            simd.store(values, o, simd.load(values, o) - moved)
    for o in range(n * _LANES, values.shape[0]):
        first[o] = first[o] * beta1 + gradients[o] * keep1
        second[o] = second[o] * beta2 + gradients[o] * gradients[o] * keep2
        values[o] -= first[o] * step / (math.sqrt(second[o] * inverse2) + eps)


@parallel
def adam_rows(
    values, gradients, first, second, multipliers, rate, beta1, beta2, eps, correction1, correction2
):
    """Update (N, D) arrays in place, the step of row i scaled by multipliers[i].

    The multiplier scales the step, not the gradient, to which Adam is indifferent. A row with
    multiplier 0 is not touched at all: neither its values nor its moments change.
    """
    n, width = values.shape
    keep1, keep2 = _ONE - beta1, _ONE - beta2
    step, inverse2 = rate / correction1, _ONE / correction2
    for i in prange(n):
        if multipliers[i] == float32(0):
            continue
        for k in range(width):
            gradient = gradients[i, k]
            m = first[i, k] * beta1 + gradient * keep1
            v = second[i, k] * beta2 + gradient * gradient * keep2
            first[i, k], second[i, k] = m, v
            values[i, k] -= multipliers[i] * (m * step / (math.sqrt(v * inverse2) + eps))
