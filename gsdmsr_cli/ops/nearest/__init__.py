"""Finds the nearest of few points for each of many, exactly."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.nearest import cpu as kernels
from gsdmsr_cli.ops.nearest import cuda
from gsdmsr_cli.ops.nearest.twin import nearest_twin


@torch.no_grad()
def nearest_nodes(points: Tensor, nodes: Tensor, near: Tensor) -> Tensor:
    """Return the rows of the nearest nodes of each point, in ascending order, (N, K) int32.

    Args:
        points, nodes: (N, 3), (M, 3).
        near: (N, K) int32, rows that may be the nearest's, as those of a moment ago are, or zeros:
            what they are changes nothing but the time it takes. K is at most M.
    """
    form = choose(points, nodes)
    if form == "cuda":
        return cuda.nearest(points, nodes, near)
    if form == "cpu":
        found = near.clone()
        kernels.nearest(array(points.contiguous()), array(nodes.contiguous()), array(found))
        return found
    return nearest_twin(points, nodes, near)
