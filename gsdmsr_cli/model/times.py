"""Times around which splats begin to be seen, for motions and layers that give each its own."""

from __future__ import annotations

import torch
from torch import Tensor

_STEP = (5**0.5 - 1) / 2
"""Multiples of the golden section, less their whole parts, fill [0, 1) evenly at any number."""

SHORTEST = -20.0
"""Least logarithm of a duration that counts: no capture has frames that are so short."""


def spread_times(count: int) -> Tensor:
    """Return times (N,) that are spread evenly over [0, 1), also among neighbouring rows.

    They depend on the row alone, so that all layers of a model begin with the same.
    """
    return ((0.5 + _STEP * torch.arange(count, dtype=torch.float64)) % 1).float()


@torch.no_grad()
def take_known(centres: Tensor, times: Tensor) -> None:
    """Set centres (N,), in place, to the times (N,) that are known, which are not NaN."""
    centres.copy_(torch.where(times.isnan(), centres, times))


def inverse_durations(log_durations: Tensor) -> Tensor:
    """Return 1 / duration of each splat, (N,), finite however short it is."""
    return torch.exp(-log_durations.clamp(min=SHORTEST))
