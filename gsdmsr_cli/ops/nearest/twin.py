"""The nearest of few points for each of many, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

_CHUNK = 8192
"""Points that are compared with all nodes at a time; bounds the memory, not the result."""


def nearest_twin(points: Tensor, nodes: Tensor, near: Tensor) -> Tensor:
    """Return what ``nearest_nodes`` does, in plain torch, for any device and dtype."""
    parts = [torch.empty_like(near[:0])]
    for some in points.split(_CHUNK):
        distances = (some[:, None] - nodes).square().sum(dim=2)
        found = distances.topk(near.shape[1], largest=False).indices
        parts.append(found.sort(dim=1).values.to(torch.int32))
    return torch.cat(parts)
