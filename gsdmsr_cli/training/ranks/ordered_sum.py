"""Adds up the gradients of all ranks' views in the views' order, as one process would.

Floating-point sums depend on their order, and an ordinary all-reduce has another one for every
number of ranks. Here each rank adds up one part of all values: it gets that part of every view's
gradients, adds them in order, and gives the sums to all. That is as much traffic as a ring's
all-reduce where each rank has one view: 2 (W - 1) / W times the values, of W ranks.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.training.ranks.link import Link

_NOTHING = -0.0
"""What stands for a gradient that is not there: x + (-0.0) is x for every x, 0.0 and -0.0 too."""


def shares(views: int, ranks: int) -> list[int]:
    """Return how many of a step's views each rank has: view i is rank (i modulo ranks)'s."""
    return [len(range(rank, views, ranks)) for rank in range(ranks)]


def sum_in_order(
    link: Link,
    own: Sequence[Sequence[Tensor | None]],
    like: Sequence[Tensor],
    views: int,
) -> list[Tensor]:
    """Return the sums of the gradients of all views, -0.0 where no view has any.

    Args:
        link: to the other ranks.
        own: gradients of this rank's views by each of the trained tensors.
        like: the trained tensors, float32.
        views: of the step.
    """
    sizes = [tensor.numel() for tensor in like]
    part = -(-sum(sizes) // link.size)
    parts = torch.full((link.size, len(own), part), _NOTHING)
    for row, gradients in enumerate(own):
        flat = torch.full((link.size * part,), _NOTHING)
        for place, gradient in zip(flat[: sum(sizes)].split(sizes), gradients, strict=True):
            if gradient is not None:
                place.copy_(gradient.flatten())
        parts[:, row] = flat.view(link.size, part)
    dealt = link.deal(parts, shares(views, link.size))
    total = dealt[0][0].clone()
    for view in range(1, views):
        total += dealt[view % link.size][view // link.size]
    whole = torch.cat(link.gather(total))[: sum(sizes)]
    return [flat.view(t.shape) for flat, t in zip(whole.split(sizes), like, strict=True)]
