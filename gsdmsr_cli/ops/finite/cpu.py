"""Tells whether many numbers are all finite, in one pass over memory."""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import parallel

_BLOCKS = 16
_LANES = simd.LANES


@parallel
def all_finite(places):
    """Return whether all values of some arrays are finite.

    A number times 0 is 0 if it is finite, and not a number if it is not.

    Args:
        places: (K, 2) int64, the address of each float32 array and its length.
    """
    sums = np.zeros(_BLOCKS, np.float32)
    for block in prange(_BLOCKS):
        total = float32(0)
        for t in range(places.shape[0]):
            length = places[t, 1]
            values = simd.at_address(places[t, 0], length)
            vectors = length // _LANES
            low = vectors * block // _BLOCKS * _LANES
            high = vectors * (block + 1) // _BLOCKS * _LANES
            zeros = simd.splat(float32(0))
            for o in range(low, high, _LANES):
                zeros = zeros + simd.load(values, o) * float32(0)
            total += simd.reduce_sum(zeros)
            if block == _BLOCKS - 1:
                for o in range(high, length):
                    total += values[o] * float32(0)
        sums[block] = total
    return sums.sum() == float32(0)
