"""What motions share that read grids: their tensors as parameters, their times, their rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def split_times(rows: Tensor, count: int) -> Sequence[Tensor]:
    """Return the rows (N, K) of each of ``count`` times, which ``rows`` (count N, K) holds."""
    return [rows] if count == 1 else rows.unflatten(0, (count, len(rows) // count)).unbind()


def time_nodes(frames: int, cells_per_frame: float, least: int = 8) -> int:
    """Return the nodes of a time grid for so many distinct times, ``least`` or more."""
    return max(round(frames * cells_per_frame), least)


def between(values: Tensor, time: float) -> Tensor:
    """Return what values (T, ...) of evenly spaced times are at a time in [0, 1]."""
    place = min(max(time, 0.0), 1.0) * (len(values) - 1)
    before = min(int(place), len(values) - 2)
    return torch.lerp(values[before], values[before + 1], place - before)
