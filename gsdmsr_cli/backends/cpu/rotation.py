"""Rotations of unit quaternions wxyz, and their gradients, for kernels to inline."""

from __future__ import annotations

from numba import float32

from gsdmsr_cli.backends.cpu.jit import inline

_ONE, _TWO = float32(1), float32(2)


@inline
def rotation(a, b, c, d):
    """Return the nine entries of the rotation matrix, by rows."""
    return (
        _ONE - _TWO * (c * c + d * d),
        _TWO * (b * c - a * d),
        _TWO * (b * d + a * c),
        _TWO * (b * c + a * d),
        _ONE - _TWO * (b * b + d * d),
        _TWO * (c * d - a * b),
        _TWO * (b * d - a * c),
        _TWO * (c * d + a * b),
        _ONE - _TWO * (b * b + c * c),
    )


@inline
def rotation_backward(a, b, c, d, d00, d01, d02, d10, d11, d12, d20, d21, d22):
    """Return the gradient of the quaternion, given those of the matrix's entries."""
    return (
        _TWO * (d * (d10 - d01) + c * (d02 - d20) + b * (d21 - d12)),
        _TWO * (c * (d10 + d01) + d * (d20 + d02) - _TWO * b * (d11 + d22) + a * (d21 - d12)),
        _TWO * (b * (d10 + d01) + d * (d21 + d12) - _TWO * c * (d00 + d22) + a * (d02 - d20)),
        _TWO * (b * (d20 + d02) + c * (d21 + d12) - _TWO * d * (d00 + d11) + a * (d10 - d01)),
    )
