"""What terms share that compare how splats move with how their neighbours do.

Their values are in units of the distance between neighbours, so that a weight means the same in any
unit of the world and for any number of splats.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.training.losses import Seen
from gsdmsr_cli.training.losses._comparing import ComparingTerm, Schedule, finite_rows_of, nothing

MOST = 8192
"""Splats that neighbours are looked for among, chosen at random where there are more."""


@dataclass(frozen=True)
class NeighbourOptions(Schedule):
    """Settings of every term that compares neighbours.

    Attributes:
        neighbours: how many of its nearest others a splat is compared with.
        samples: splats that are compared with theirs, chosen at random for each view.
    """

    neighbours: int = 8
    samples: int = 512

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("neighbours", "samples"):
            require(self, key, getattr(self, key) >= 1, "1 or more")


@dataclass(frozen=True, eq=False)
class Neighbourhoods:
    """S splats and K neighbours of each; a splat may be among its own, which adds nothing.

    Attributes:
        rows: (S,) int64, the splats.
        near: (S, K) int64, their neighbours.
        weights: (S, K), less the further away; their sum is 1.
        size: (), root mean square of the distances [world units].
    """

    rows: Tensor
    near: Tensor
    weights: Tensor
    size: Tensor

    def apart(self, means: Tensor) -> Tensor:
        """Return the way from each splat to its neighbours, (S, K, 3), of means (N, 3)."""
        return means[self.near] - means[self.rows][:, None]


@torch.no_grad()
def neighbourhoods(
    places: Tensor, known: Tensor, options: NeighbourOptions, seed: int
) -> Neighbourhoods | None:
    """Return some splats and their neighbours, or None if there are not two splats.

    Args:
        places: (N, 3) where the splats are.
        known: (M,) int64, those that may be chosen.
        options: how many.
        seed: of which are chosen.
    """
    shuffled = torch.randperm(len(known), generator=torch.Generator().manual_seed(seed))
    chosen = known[shuffled[:MOST].to(known.device)]
    if len(chosen) < 2:
        return None
    rows, kept = chosen[: options.samples], min(options.neighbours + 1, len(chosen))
    guesses = torch.zeros(len(rows), kept, dtype=torch.int32, device=places.device)
    near = chosen[nearest_points(places[rows], places[chosen], guesses).long()]
    squares = (places[near] - places[rows][:, None]).square().sum(dim=2)
    others = near != rows[:, None]
    mean = (squares * others).sum() / others.sum()
    mean = mean.clamp(min=torch.finfo(mean.dtype).tiny)
    weights = torch.exp(-squares / (2 * mean)) * others
    return Neighbourhoods(rows, near, weights / weights.sum(), mean.sqrt())


class NeighbourTerm(ComparingTerm):
    """The weighted mean, over neighbours, of what a subclass takes for wrong.

    A neighbour at the distance d has the weight exp(-d^2 / (2 size^2)) (Dynamic 3D Gaussians,
    Luiten et al. 2024, equation 5, whose width is a constant), both at the second time.

    Attributes:
        needs_quats: whether it compares rotations, which splats drawn from axes do not have.
    """

    needs_seed = True
    needs_quats: ClassVar[bool] = False

    def __init__(self, options: NeighbourOptions) -> None:
        super().__init__(options)
        self.options = options

    def __call__(self, seen: Seen) -> Tensor:
        """Return the weighted mean ().

        Raises:
            UsageError: the term compares rotations, and the model has none.
        """
        if seen.other is None:
            return nothing(seen)
        if self.needs_quats and seen.moment.axes is not None:
            name = type(self).__module__.rpartition(".")[2]
            raise UsageError(
                f"the term '{name}' compares rotations, which splats that are drawn from axes "
                "do not have; take arap"
            )
        now, other = seen.moment.splats, seen.other.splats
        known = finite_rows_of(now, other)
        found = neighbourhoods(other.means, known, self.options, seen.seed)
        if found is None:
            return nothing(seen)
        return (found.weights * self.deviations(now, other, found)).sum()

    @abstractmethod
    def deviations(self, now: Splats, other: Splats, found: Neighbourhoods) -> Tensor:
        """Return how wrong the move of each neighbour is, (S, K), in units of ``found.size``."""


def lengths(ways: Tensor) -> Tensor:
    """Return the lengths (S, K) of ways (S, K, C), whose gradient is 0 where they are 0."""
    found: Tensor = torch.linalg.vector_norm(ways, dim=2)
    return found
