"""The nearest of few queries for each of many, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

_CHUNK = 8192
"""Queries that are compared with all points at a time; bounds the memory, not the result."""


def nearest_twin(queries: Tensor, points: Tensor, near: Tensor) -> Tensor:
    """Return what ``nearest_points`` does, in plain torch, for any device and dtype."""
    parts = [torch.empty_like(near[:0])]
    for some in queries.split(_CHUNK):
        distances = (some[:, None] - points).square().sum(dim=2)
        found = distances.topk(near.shape[1], largest=False).indices
        parts.append(found.sort(dim=1).values.to(torch.int32))
    return torch.cat(parts)
