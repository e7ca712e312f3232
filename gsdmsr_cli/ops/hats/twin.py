"""Shares of nodes in plain torch, on any device."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def hats_twin(times: Sequence[float], values: Tensor) -> Tensor:
    """Return what ``hats`` does."""
    last = len(values) - 1
    places = torch.tensor(times, dtype=values.dtype, device=values.device).clamp(0, 1) * last
    nodes = torch.arange(last + 1, dtype=values.dtype, device=values.device)
    return (1 - (places[:, None] - nodes).abs()).clamp(min=0)
