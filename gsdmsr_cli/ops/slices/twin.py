"""Slices in plain torch."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.ops.slices.cpu import LEAST_VARIANCE

_LEFT = (
    ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
    ((0, -1, 0, 0), (1, 0, 0, 0), (0, 0, 0, -1), (0, 0, 1, 0)),
    ((0, 0, -1, 0), (0, 0, 0, 1), (1, 0, 0, 0), (0, -1, 0, 0)),
    ((0, 0, 0, -1), (0, 0, -1, 0), (0, 1, 0, 0), (1, 0, 0, 0)),
)
"""The matrices of v -> 1 v, i v, j v and k v."""


class Slices(NamedTuple):
    """What slices of N Gaussians have at all times.

    Attributes:
        variances: (N,) S_tt.
        velocities: (N, 3) S_xt / S_tt [world units / duration of the capture].
        axes: (N, 3, 3) A with A A^T = S_xx - S_xt S_tx / S_tt [world units].
    """

    variances: Tensor
    velocities: Tensor
    axes: Tensor


def slices_twin(quats: Tensor, log_scales: Tensor, tilts: Tensor, log_durations: Tensor) -> Slices:
    """Return what ``slices`` does, for any device and dtype.

    S is M M^T. With m the row of M that is time and U an orthonormal basis of what is
    perpendicular to it, A is the other three rows times U: for a unit quaternion m, that basis is
    m i, m j and m k.
    """
    tilt = _right_products(torch.nn.functional.normalize(tilts, dim=1))
    in_time = tilt[:, :, :1] * log_durations.exp()[:, None, None]
    spatial = tilt[:, :, 1:] @ scaled_axes(quats, log_scales)
    time, space = torch.cat([in_time, spatial], dim=2).split([1, 3], dim=1)
    variances = time.square().sum(dim=(1, 2)).clamp(min=LEAST_VARIANCE)
    velocities = (space @ time.mT)[:, :, 0] / variances[:, None]
    across = _left_products(time[:, 0] / variances.sqrt()[:, None])[:, :, 1:]
    return Slices(variances, velocities, space @ across)


def _left_products(quats: Tensor) -> Tensor:
    """Return the (N, 4, 4) matrices of v -> q v, for quaternions q (N, 4) wxyz."""
    entries = quats @ quats.new_tensor(_LEFT).flatten(1)
    return entries.view(-1, 4, 4)


def _right_products(quats: Tensor) -> Tensor:
    """Return the (N, 4, 4) matrices of v -> v q, for quaternions q (N, 4) wxyz.

    v q is the conjugate of q* v*, so the matrix is that of q* from the left, conjugated.
    """
    signs = torch.tensor([1.0, -1.0, -1.0, -1.0], dtype=quats.dtype, device=quats.device)
    return signs[:, None] * _left_products(quats * signs) * signs
