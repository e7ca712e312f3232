"""Finds the rows of a gradient that hold anything: those of splats to learn something from."""

from __future__ import annotations

from numba import float32

from gsdmsr_cli.backends.cpu.jit import serial


@serial
def find_live(values, rows):
    """Write the numbers of the rows of (N, K) that are not all 0, and return how many there are.

    Args:
        rows: (N,) int64 room; what lies behind those found is left as it is.
    """
    count = 0
    for i in range(values.shape[0]):
        for k in range(values.shape[1]):
            if values[i, k] != float32(0):
                rows[count] = i
                count += 1
                break
    return count
