"""Adam with a multiplier per row and a true skip of rows (Kingma & Ba 2015)."""

from __future__ import annotations

import math

from numba import float32, prange

from gsdmsr_cli.kernels import simd
from gsdmsr_cli.kernels.jit import inline, parallel

_BLOCKS = 16
_LANES = simd.LANES
_ONE = float32(1)


VALUES, GRADIENTS, FIRST, SECOND, LENGTH, WIDTH = range(6)
"""Columns of the table of tensors: four addresses, the number of values, and the values per row if
rows have multipliers, else 0."""


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


@parallel
def adam(tensors, steps, multipliers, beta1, beta2, eps):
    """Update tensors in place: values, first and second moments.

    A multiplier scales the step, not the gradient, to which Adam is indifferent. A row with
    multiplier 0 is not touched at all: neither its values nor its moments change.

    Args:
        tensors: (K, 6) int64, see ``VALUES``; contiguous float32.
        steps: (K, 2) float32, rate / (1 - beta1^step) and 1 / (1 - beta2^step).
        multipliers: (N,) float32, of the rows of the tensors whose width is not 0.
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
            if width == 0:
                vectors = length // _LANES
                low = vectors * block // _BLOCKS * _LANES
                high = vectors * (block + 1) // _BLOCKS * _LANES
                if block == _BLOCKS - 1:
                    high = length
                _update(values, gradients, first, second, low, high, keep, step, inverse2)
                continue
            rows = length // width
            for row in range(rows * block // _BLOCKS, rows * (block + 1) // _BLOCKS):
                if multipliers[row] != float32(0):
                    low, scaled = row * width, step * multipliers[row]
                    high = low + width
                    _update(values, gradients, first, second, low, high, keep, scaled, inverse2)
