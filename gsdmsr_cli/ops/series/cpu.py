"""Series on arrays: a row of coefficients is read once, or its gradient written once."""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu.jit import inline, parallel

_ZERO = float32(0)


@parallel
def add(start, coefficients, basis, scale, first, channels, found):
    """Write the sums of N splats.

    Args:
        start: (N, D).
        coefficients: (N, J, C).
        basis: (N, K), or (1, K) for all.
        scale: of the series.
        first: coefficient that the first value of the basis is of.
        channels: a tuple of C, for whose length the kernel is compiled.
        found: (N, D) out.
    """
    own = basis.shape[0] > 1
    for i in prange(start.shape[0]):
        row = np.int64(i) if own else 0
        for c in range(start.shape[1]):
            found[i, c] = start[i, c]
        for k in range(basis.shape[1]):
            factor = scale * basis[row, k]
            for c in range(len(channels)):
                found[i, c] += factor * coefficients[i, first + k, c]


@inline
def _is_live(d_found, i, count):
    """Return whether a row's gradient holds anything."""
    live = False
    for c in range(count):
        live |= d_found[i, c] != _ZERO
    return live


@parallel
def add_backward(coefficients, basis, d_found, scale, first, channels, d_coefficients, d_basis):
    """Write the gradients of ``add``; that of the start is ``d_found`` itself.

    Args:
        d_coefficients: (N, J, C) out, 0 so far where ``basis`` has no value for a coefficient.
        d_basis: (N, K) out, or (0, 0) if not wanted.
    """
    own, wanted, count = basis.shape[0] > 1, d_basis.shape[0] > 0, len(channels)
    for i in prange(coefficients.shape[0]):
        row = np.int64(i) if own else 0
        live = _is_live(d_found, i, count)
        for k in range(basis.shape[1]):
            factor, total = scale * basis[row, k] if live else _ZERO, _ZERO
            for c in range(count):
                if wanted and live:
                    total += d_found[i, c] * coefficients[i, first + k, c]
                d_coefficients[i, first + k, c] = factor * d_found[i, c]
            if wanted:
                d_basis[i, k] = scale * total
