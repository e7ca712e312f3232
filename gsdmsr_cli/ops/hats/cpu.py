"""Shares of nodes on arrays."""

from __future__ import annotations

from numba import float32

from gsdmsr_cli.backends.cpu.jit import serial

_ZERO, _ONE = float32(0), float32(1)


@serial
def hats(times, found):
    """Write the shares (V, F) of nodes at times (V,)."""
    last = found.shape[1] - 1
    for v in range(found.shape[0]):
        place = min(max(times[v], _ZERO), _ONE) * float32(last)
        for f in range(found.shape[1]):
            found[v, f] = max(_ONE - abs(place - float32(f)), _ZERO)
