"""Finds the nearest of few points for each of many queries, exactly."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.nearest import cpu as kernels
from gsdmsr_cli.ops.nearest import cuda
from gsdmsr_cli.ops.nearest.twin import nearest_twin


class Nearest:
    """A search for the nearest points, which is quick where it is repeated after small moves.

    What it remembers of earlier searches changes nothing but the time that the next one takes.
    """

    def __init__(self, kept: int) -> None:
        """Look for ``kept`` points for each query."""
        self._begin(torch.zeros(0, kept, dtype=torch.int32), 0)

    def _begin(self, near: Tensor, count: int) -> None:
        """Remember guesses (N, K), and nothing of where queries and ``count`` points are."""
        self._near = near
        self._places, self._until = torch.zeros(len(near), 3), torch.zeros(len(near))
        self._before, self._drift = torch.zeros(count, 3), torch.zeros(1, dtype=torch.float64)

    @torch.no_grad()
    def find(self, queries: Tensor, points: Tensor) -> Tensor:
        """Return the rows of the nearest points of each query, in ascending order, (N, K) int32.

        Args:
            queries: (N, 3).
            points: (M, 3), M at least K.
        """
        sizes = len(self._near), len(self._before)
        if sizes != (len(queries), len(points)) or self._near.device != queries.device:
            kept = self._near.shape[1]
            guesses = torch.zeros(len(queries), kept, dtype=torch.int32, device=queries.device)
            self._begin(guesses, len(points))
        form = choose(queries, points)
        if form == "cuda":
            self._near = cuda.nearest(queries, points, self._near)
        elif form == "cpu":
            self._near = self._near.clone()  # whoever has the earlier result keeps it as it is
            remembered = self._places, self._until, self._before, self._drift
            given = queries.contiguous(), points.contiguous(), self._near, *remembered
            kernels.nearest(*(array(tensor) for tensor in given))
        else:
            self._near = nearest_twin(queries, points, self._near)
        return self._near


def nearest_points(queries: Tensor, points: Tensor, near: Tensor) -> Tensor:
    """Return the rows of the nearest points of each query, in ascending order, (N, K) int32.

    Args:
        queries: (N, 3).
        points: (M, 3).
        near: (N, K) int32, rows that may be the nearest's, or zeros: what they are changes nothing
            but the time it takes. K is at most M.
    """
    search = Nearest(near.shape[1])
    search._begin(near.contiguous(), len(points))
    return search.find(queries, points)
