"""Adds a decoder's output to the stored splats: means, rotations and log scales in one pass."""

from __future__ import annotations

from numba import prange

from gsdmsr_cli.backends.cpu.jit import parallel

MEAN, QUAT, SCALE = 3, 4, 3


@parallel
def displace(means, quats, log_scales, deformation, shift, moved, turned, scaled):
    """Write the sums of N splats.

    Args:
        deformation: (N, 10) offsets of means, quaternions and log scales.
        shift: (N, 3) a further offset of the means, or (0, 3) for none.
        moved, turned, scaled: (N, 3), (N, 4), (N, 3) out.
    """
    shifted = shift.shape[0] > 0
    for i in prange(means.shape[0]):
        for k in range(MEAN):
            moved[i, k] = means[i, k] + deformation[i, k]
            if shifted:
                moved[i, k] += shift[i, k]
        for k in range(QUAT):
            turned[i, k] = quats[i, k] + deformation[i, MEAN + k]
        for k in range(SCALE):
            scaled[i, k] = log_scales[i, k] + deformation[i, MEAN + QUAT + k]


@parallel
def displace_backward(d_moved, d_turned, d_scaled, d_deformation):
    """Write the gradient of the deformation; those of all other arguments are what is given."""
    for i in prange(d_moved.shape[0]):
        for k in range(MEAN):
            d_deformation[i, k] = d_moved[i, k]
        for k in range(QUAT):
            d_deformation[i, MEAN + k] = d_turned[i, k]
        for k in range(SCALE):
            d_deformation[i, MEAN + QUAT + k] = d_scaled[i, k]
