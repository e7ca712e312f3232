"""What motions share that read grids: their tensors as parameters, their times, their rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.model.parameter import Place, evenly


def split_times(rows: Tensor, count: int) -> Sequence[Tensor]:
    """Return the rows (N, K) of each of ``count`` times, which ``rows`` (count N, K) holds."""
    return [rows] if count == 1 else rows.unflatten(0, (count, len(rows) // count)).unbind()


def time_nodes(frames: int, cells_per_frame: float, least: int = 8) -> int:
    """Return the nodes of a time grid for so many distinct times, ``least`` or more."""
    return max(round(frames * cells_per_frame), least)


def sparser_at_ends(density: float) -> Place:
    """Return where times lie on a grid whose nodes are ``density`` times as dense at both ends.

    Views before and after a node tell of it, but of the first and the last only those of one side.
    With u = 2 t - 1 in [-1, 1] and a = (1 - density) / (3 - density), the place is
    (u - a u^3) / (1 - a): its slope at the ends is ``density`` times that of an even grid, in the
    middle up to 1.5 times.

    Args:
        density: above 0, at most 1, where nodes are evenly spaced.
    """
    if density == 1:
        return evenly
    cubic = (1 - density) / (3 - density)

    def place(time: float) -> float:
        u = 2 * time - 1
        value = (1 + u * (1 - cubic * u * u) / (1 - cubic)) / 2
        return min(max(value, 0.0), 1.0)  # not -1e-16, which has no node

    return place


def between(values: Tensor, time: float) -> Tensor:
    """Return what values (T, ...) of evenly spaced times are at a time in [0, 1]."""
    place = min(max(time, 0.0), 1.0) * (len(values) - 1)
    before = min(int(place), len(values) - 2)
    return torch.lerp(values[before], values[before + 1], place - before)
