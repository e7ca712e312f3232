"""Cells of splats move as rigid bodies, large ones, and smaller ones within them.

Hierarchical coherent motion (HiCoM: Gao et al., NeurIPS 2024): moment after moment, each cell of a
few levels learns how it is displaced and turned, and a splat does what all cells that it is in do.
Splats that share a motion are seen by more pixels, and a moment takes the bytes of its cells.
Cells are halves of halves of the splats of the first moment, and the same at all moments. Levels
may join one after the other, the largest cells first, as in Scale-GS (Yang et al. 2025).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.motion._arcs import added_to_none, turned
from gsdmsr_cli.model.motion._halving import cells_of
from gsdmsr_cli.model.motion._streamed import Knot, Streamed
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.strict import require, require_rates

STREAMED = True
"""It is learnt moment after moment."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        splats: how many splats a cell has at most, from the largest cells to the smallest.
        join: progress of a moment from which on each level learns, ascending; a number for each, or
            none where all do from the start.
        rate: learning rate of the displacements at the start and the end of a moment [scene
            bounds].
        turn_rate: that of the rotations.
    """

    splats: tuple[int, ...] = (512, 64, 8)
    join: tuple[float, ...] = ()
    rate: tuple[float, float] = (2e-3, 1e-4)
    turn_rate: tuple[float, float] = (4e-3, 2e-4)

    def __post_init__(self) -> None:
        falls = all(larger > smaller for larger, smaller in pairwise(self.splats))
        require(self, "splats", bool(self.splats) and falls, "one number or more, which descend")
        require(self, "splats", not self.splats or self.splats[-1] >= 1, "1 or more each")
        require_rates(self, "rate", "turn_rate")
        number = len(self.join) in (0, len(self.splats))
        require(self, "join", number, f"a progress for each of the {len(self.splats)} levels")
        rises = all(0 <= a <= b < 1 for a, b in pairwise((0.0, *self.join)))
        require(self, "join", rises, "ascending, each 0 or more, below 1")


class Cells(Streamed):
    """x plus the sum over its cells of d + (R(q) - 1)(x - m); m is the mean of a cell's splats.

    The rows are the cells, those of the largest level first. Rotations of levels are added up as
    what they add to the quaternion of no rotation.

    Attributes:
        cells: (N,) int32, the smallest cell that a splat is in; all 0 until the first moment is
            over.
        around: (C,) int32, the next larger cell that a cell is in; itself, for the largest.
        middles: (C, 3), means of the cells' splats at the first moment [scene bounds].
    """

    staying = "cells", "around", "middles"

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.options = options
        self._joined = len(options.splats)
        self.cells = torch.zeros(count, dtype=torch.int32)
        self.around, self.middles = torch.zeros(1, dtype=torch.int32), torch.zeros(1, 3)
        levels = len(options.splats)  # each of which has a cell for every splat, if it comes to it
        own = [
            Parameter("cells", self.cells, per_splat=True),
            Parameter("around", self.around, rows_per_splat=levels),
            Parameter("middles", self.middles, rows_per_splat=levels),
        ]
        super().__init__(facts, 1, False, (options.rate, options.turn_rate), own, levels)

    def of_splats(self, means: Tensor, index: int) -> Knot:
        """Return what all cells that each splat is in do together."""
        sums = self._with_larger(self._affine(self._learning(index)))
        axes, shifts, turns = sums.index_select(0, self.cells).split([9, 3, 4], dim=1)
        places = (means.detach() / self.bound)[:, None, :]
        return Knot((axes.unflatten(1, (3, 3)) * places).sum(dim=2) + shifts, turns)

    def advance(self, progress: float) -> None:
        """Let the levels learn whose time has come."""
        join = self.options.join
        self._joined = sum(progress >= own for own in join) if join else len(self.options.splats)

    def _learning(self, index: int) -> Knot:
        """Return the rows of a moment, those of levels that do not learn yet without gradients."""
        rows, levels = self.knot(index), len(self.options.splats)
        if self._joined == levels or not torch.is_grad_enabled():
            return rows
        learns = (self._levels() < self._joined)[:, None]
        return Knot(*(torch.where(learns, own, own.detach()) for own in rows))

    def _levels(self) -> Tensor:
        """Return the level of each cell (C,), 0 of the largest."""
        around = self.around.long()
        place, found = torch.arange(len(around), device=around.device), torch.zeros_like(around)
        for _ in range(len(self.options.splats) - 1):
            found += place != around[place]
            place = around[place]
        return found

    def _affine(self, rows: Knot) -> Tensor:
        """Return A, b and turns (C, 16) of cells that displace by A x + b [scene bounds]."""
        quats = turned(rows.turns)
        axes = quat_to_rotmat(quats) - torch.eye(3, device=quats.device)
        shifts = rows.offsets - (axes @ self.middles[:, :, None])[:, :, 0]
        return torch.cat([axes.flatten(1), shifts, added_to_none(quats)], dim=1)

    def _with_larger(self, own: Tensor) -> Tensor:
        """Return the sums (C, K) over each cell and all larger ones that it is in, of (C, K)."""
        around, total = self.around.long(), own
        larger = around != torch.arange(len(around), device=around.device)
        for _ in range(len(self.options.splats) - 1):
            total = own + torch.where(larger[:, None], total.index_select(0, around), 0.0)
        return total

    @torch.no_grad()
    def settle(self, splats: Splats, first: bool) -> None:
        """See ``Streamed.settle``; the first moment's splats are sorted into cells."""
        super().settle(splats, first)
        if not first or not len(splats):
            return
        places = splats.means.detach() / self.bound
        levels = torch.from_numpy(cells_of(places.cpu().numpy(), self.options.splats))
        levels = levels.to(places.device)
        count = int(levels.max()) + 1
        for parameter in self.parameters():
            if parameter.name not in ("cells", "times"):
                shape = count, *parameter.tensor.shape[1:]
                parameter.set_values(parameter.tensor.new_zeros(shape))
        self.cells.copy_(levels[:, -1])
        larger = levels[:, 0]
        for own in levels.unbind(dim=1):
            self.around[own.long()] = larger
            self.middles.index_add_(0, own, places)
            larger = own
        self.middles.div_(torch.bincount(levels.flatten(), minlength=count)[:, None])

    def check(self) -> None:
        """Raise ValueError unless there is a row for every cell, too."""
        super().check()
        known = len(self.offsets)
        if not len(self.middles) == len(self.around) == known:
            raise ValueError(f"{len(self.around)} and {len(self.middles)} of {known} cells")
        for named in (self.cells, self.around):
            if named.numel() and not 0 <= int(named.min()) <= int(named.max()) < known:
                raise ValueError(f"cells that are not among the {known} of the motion")


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Cells:
    """Return a motion that is the identity until it has been trained."""
    return Cells(options, facts, len(splats))
