"""Spreads control points over splats: farthest-point sampling after a grid has made them few."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.neighbours.cpu import mean_squares, near_order
from gsdmsr_cli.ops.spread import cpu as kernels

CANDIDATES = 32
"""Points are chosen among so many for each of them, or up to twice as many."""

SPACING_OF = 3
"""How many of the nearest others say how far apart points are."""

_BITS = 20
"""Of a coordinate in a Morton code."""

_STRETCHES = (
    (32, 0x001F00000000FFFF), (16, 0x001F0000FF0000FF), (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249),
)  # fmt: skip
"""By how much to shift and what to keep, to make room for two bits between any two of 21."""


def spread_out(points: Tensor, count: int, weights: Tensor | None = None) -> Tensor:
    """Return ``count`` of the points (N, 3) that are far from each other, on the CPU.

    Some repeatedly if there are fewer. Points are looked at on their device; what comes to the CPU
    is at most ``2 CANDIDATES count`` of them, but for clouds most of which lie within a millionth
    of their extent. Chosen points that follow each other lie near each other, which makes
    ``ops.nearest`` quick.

    Args:
        points: finite, N at least 1.
        count: 1 or more.
        weights: (N,) above 0, by what each one's distance from those chosen is multiplied: points
            of twice the weight are chosen half as far from each other. None is 1 for all.
    """
    rows = _candidates(points.detach(), CANDIDATES * count)
    given = points.detach()[rows].cpu().double().contiguous()
    squares = torch.ones(len(rows), dtype=torch.float64)
    if weights is not None:
        squares = weights.detach()[rows].cpu().double().square()
    chosen = torch.empty(count, dtype=torch.int64)
    kernels.choose_spread(array(given), array(squares), int(rows.argmin()), array(chosen))
    found = given[chosen]
    return found[torch.from_numpy(near_order(array(found)))].float()


def _candidates(points: Tensor, least: int) -> Tensor:
    """Return rows of points that stand for all, at least ``least`` of them if there are so many.

    One point of every occupied cell of a grid, that of the lowest code, cell by cell: cells are
    halved, across one axis after the other, until enough are occupied; fewer than twice as many
    are then.
    """
    codes, order = _morton(points.double()).sort(stable=True)
    # of each point the highest bit in which it differs from the one before; 0 if in none
    highest = torch.frexp((codes[1:] ^ codes[:-1]).double()).exponent.long()
    differing = highest.bincount(minlength=3 * _BITS + 2)
    cells = 1 + differing.flip(0).cumsum(0).flip(0)
    bit = max(int((cells >= least).sum()) - 1, 0)
    return order[torch.cat([torch.ones_like(order[:1]), highest >= bit]).bool()]


def _morton(points: Tensor) -> Tensor:
    """Return the places (N, 3) of points in a grid of 2^20 cells along the longest axis, as codes.

    Their bits take turns (Morton 1966): x, y, z of the largest cells first.
    """
    lower, upper = points.amin(dim=0), points.amax(dim=0)
    extent = (upper - lower).amax().clamp(min=torch.finfo(points.dtype).tiny)
    cells = ((points - lower) / extent * (2**_BITS - 1)).long()
    for shift, kept in _STRETCHES:
        cells = (cells | cells << shift) & kept
    x, y, z = cells.unbind(1)
    codes: Tensor = x << 2 | y << 1 | z
    return codes


def spacing(points: Tensor) -> Tensor:
    """Return the root mean square of the distances of each point to its nearest others, (M,)."""
    squares = mean_squares(array(points.detach().cpu().double().contiguous()), SPACING_OF)
    return torch.from_numpy(squares).sqrt().float()
