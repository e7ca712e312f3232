"""The levels of a hash grid: how fine each is, and which rows of a table are its own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda.compiler import MOST_HASH_LEVELS

PRIMES = (1, 2654435761, 805459861, 3674653429)
"""What the grid points' numbers along each axis are multiplied by (Mueller et al. 2022, Eq. 4)."""

MOST_AXES = len(PRIMES)
MOST_ROWS = 2**24
"""Of a level: the place of a value in a table of 8 features then fits into 32 bits."""

_SPREAD = 1e-4


@dataclass(frozen=True)
class Levels:
    """L levels over d axes whose values lie one after the other in one table.

    Attributes:
        resolutions: of each level, grid points along each of 2 to 4 axes, 2 or more each.
        most: rows of the table that a level has at most, a power of two up to 2^24. A level with
            no more grid points than that has a row for each, the first axis running fastest; in
            others grid points share rows by a hash.
    """

    resolutions: tuple[tuple[int, ...], ...]
    most: int

    def __post_init__(self) -> None:
        axes, sizes = self.axes, [size for level in self.resolutions for size in level]
        even = all(len(level) == axes for level in self.resolutions)
        many = 1 <= len(self.resolutions) <= MOST_HASH_LEVELS and 2 <= axes <= MOST_AXES
        power = 1 <= self.most <= MOST_ROWS and self.most & (self.most - 1) == 0
        if not (even and many and power and min(sizes) >= 2):
            raise ValueError(
                f"a hash grid has 1 to {MOST_HASH_LEVELS} levels, 2 to {MOST_AXES} axes with 2 or "
                f"more grid points each and a power of two of rows, not {self.resolutions} in "
                f"{self.most}"
            )

    @property
    def axes(self) -> int:
        """Number of coordinates of a point."""
        return len(self.resolutions[0]) if self.resolutions else 0

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """The first row of each level, and after the last the number of all rows."""
        rows = (min(math.prod(level), self.most) for level in self.resolutions)
        return tuple(accumulate(rows, initial=0))

    def is_hashed(self, level: int) -> bool:
        """Return whether grid points of a level share rows."""
        return math.prod(self.resolutions[level]) > self.most


def new_levels(lowest: Sequence[int], highest: Sequence[int], count: int, log2_most: int) -> Levels:
    """Return levels whose resolutions grow geometrically along each axis (Eq. 2 and 3).

    Args:
        lowest, highest: resolutions of the first and the last level along each axis.
        count: number of levels; the last one alone if 1.
        log2_most: binary logarithm of the rows that a level has at most.
    """
    shares = [level / (count - 1) for level in range(count - 1)] + [1.0]
    ends = list(zip(lowest, highest, strict=True))
    grown = (tuple(round(low * (high / low) ** share) for low, high in ends) for share in shares)
    return Levels(tuple(grown), 2**log2_most)


def new_table(levels: Levels, features: int, generator: torch.Generator) -> Tensor:
    """Return a table (rows, features) that starts as in the paper, uniform in +-1e-4."""
    return (2 * torch.rand(levels.offsets[-1], features, generator=generator) - 1) * _SPREAD


def check_table(levels: Levels, table: Tensor, features: int) -> None:
    """Raise ValueError unless a table has the rows and features of these levels."""
    expected = levels.offsets[-1], features
    if tuple(table.shape) != expected:
        raise ValueError(f"a table of shape {tuple(table.shape)}, not {expected}, for a hash grid")
