"""Leaves out of a backward pass the rows that nothing is to be learnt from, where they are many."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.live_rows.cpu import find_live

MOST = 0.75
"""Share of live rows above which picking them costs more than it saves."""


def live_rows(gradient: Tensor, most: float = MOST) -> Tensor | None:
    """Return which rows (M,) of (N, K) are not all 0, or None if more than a share ``most`` are."""
    rows = np.empty(len(gradient), np.int64)
    count = find_live(array(gradient), rows)
    return None if count > most * len(gradient) else torch.from_numpy(rows[:count])


def spread(picked: Tensor, rows: Tensor, count: int) -> Tensor:
    """Return (count, ...) with ``picked`` at its rows, 0 elsewhere."""
    return picked.new_zeros(count, *picked.shape[1:]).index_copy_(0, rows, picked)
