"""Adam with a multiplier per row and a true skip of rows (Kingma & Ba 2015)."""

from __future__ import annotations

import math

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel

_BLOCKS = 16
_LANES = simd.LANES
_ONE = float32(1)


VALUES, GRADIENTS, FIRST, SECOND, LENGTH, WIDTH, MULTIPLIERS, TRACE = range(8)
"""Columns of the table of tensors: four addresses, the number of values, and for tensors whose rows
have multipliers the values per row and two further addresses, else 0."""


@inline
def _update(values, gradients, first, second, low, high, keep, step, inverse2):
    """Update the values from ``low`` on, below ``high``."""
    beta1, beta2, eps = keep
    rest1, rest2, floor = _ONE - beta1, _ONE - beta2, simd.splat(eps)
    whole = low + (high - low) // _LANES * _LANES
    for o in range(low, whole, _LANES):
        gradient = simd.load(gradients, o)
        m = simd.load(first, o) * beta1 + gradient * rest1
        v = simd.load(second, o) * beta2 + gradient * gradient * rest2
        simd.store(first, o, m)
        simd.store(second, o, v)
        moved = m * step / (simd.sqrt(v * inverse2) + floor)
        simd.store(values, o, simd.load(values, o) - moved)
    for o in range(whole, high):
        first[o] = first[o] * beta1 + gradients[o] * rest1
        second[o] = second[o] * beta2 + gradients[o] * gradients[o] * rest2
        values[o] -= first[o] * step / (math.sqrt(second[o] * inverse2) + eps)


@inline
def _update_rows(
    values, gradients, first, second, trace, multipliers, width, low, high, keep, step, inverse2
):
    """Update the rows from ``low`` on, below ``high``, and write each one's full step.

    16 rows at a time, whose multipliers are spread out over as many vectors as a row has values.
    """
    beta1, beta2, eps = keep
    rest1, rest2, floor = _ONE - beta1, _ONE - beta2, simd.splat(eps)
    factors = np.empty(_LANES * width, np.float32)
    whole = low + (high - low) // _LANES * _LANES
    for start in range(low, whole, _LANES):
        for r in range(_LANES):
            factors[r * width : (r + 1) * width] = multipliers[start + r]
        for part in range(0, _LANES * width, _LANES):
            o, factor = start * width + part, simd.load(factors, part)
            gradient, m, v = simd.load(gradients, o), simd.load(first, o), simd.load(second, o)
            fresh_m = m * beta1 + gradient * rest1
            fresh_v = v * beta2 + gradient * gradient * rest2
            moved = fresh_m * step / (simd.sqrt(fresh_v * inverse2) + floor)
            value = simd.load(values, o)
            simd.store(trace, o, moved)
            simd.store(first, o, simd.where_zero(factor, m, fresh_m))
            simd.store(second, o, simd.where_zero(factor, v, fresh_v))
            simd.store(values, o, simd.where_zero(factor, value, value - moved * factor))
    for row in range(whole, high):
        factor = multipliers[row]
        for o in range(row * width, (row + 1) * width):
            m = first[o] * beta1 + gradients[o] * rest1
            v = second[o] * beta2 + gradients[o] * gradients[o] * rest2
            trace[o] = m * step / (math.sqrt(v * inverse2) + eps)
            if factor != float32(0):
                first[o], second[o] = m, v
                values[o] -= trace[o] * factor


@parallel
def adam(tensors, steps, beta1, beta2, eps):
    """Update tensors in place: values, first and second moments.

    A multiplier scales the step, not the gradient, to which Adam is indifferent. A row with
    multiplier 0 is not touched at all: neither its values nor its moments change. The trace gets
    the steps that all rows would have made with multiplier 1.

    Args:
        tensors: (K, 8) int64, see ``VALUES``; contiguous float32.
        steps: (K, 2) float32, rate / (1 - beta1^step) and 1 / (1 - beta2^step).
    """
    keep = beta1, beta2, eps
    for block in prange(_BLOCKS):
        for t in range(tensors.shape[0]):
            length, width = tensors[t, LENGTH], tensors[t, WIDTH]
            values = simd.at_address(tensors[t, VALUES], length)
            gradients = simd.at_address(tensors[t, GRADIENTS], length)
            first = simd.at_address(tensors[t, FIRST], length)
            second = simd.at_address(tensors[t, SECOND], length)
            step, inverse2 = steps[t, 0], steps[t, 1]
            count = length if width == 0 else length // width
            vectors = count // _LANES
            low = vectors * block // _BLOCKS * _LANES
            high = vectors * (block + 1) // _BLOCKS * _LANES
            if block == _BLOCKS - 1:
                high = count
            if width == 0:
                _update(values, gradients, first, second, low, high, keep, step, inverse2)
            else:
                multipliers = simd.at_address(tensors[t, MULTIPLIERS], count)
                trace = simd.at_address(tensors[t, TRACE], length)
                _update_rows(
                    values, gradients, first, second, trace, multipliers, width, low, high, keep,
                    step, inverse2,
                )  # fmt: skip
