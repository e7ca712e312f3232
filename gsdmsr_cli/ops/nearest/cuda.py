"""The nearest of few queries for each of many, on a GPU; see nearest.cu."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import recording
from gsdmsr_cli.backends.cuda.launch import blocks, launch

_THREADS = 128


def nearest(queries: Tensor, points: Tensor, near: Tensor) -> Tensor:
    """Return the rows of the nearest points of each query, in ascending order, (N, K) int32.

    Args:
        queries, points: (N, 3), (M, 3).
        near: (N, K) int32 guesses, see ``ops.nearest.nearest_points``; K is at most M.
    """
    found = recording.keep(near).clone(memory_format=torch.contiguous_format)
    count, kept = found.shape
    launch(
        "nearest", "nearest", (blocks(count, _THREADS), 1), _THREADS,
        count, len(points), kept, queries.contiguous(), points.contiguous(), found,
    )  # fmt: skip
    return found
