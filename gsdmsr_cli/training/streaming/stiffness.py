"""Holds neighbouring splats of a stream together: they move as the parts of rigid bodies do.

Dynamic 3D Gaussians (Luiten et al., 3DV 2024, section 3.3): local rigidity and the similarity of
rotations compare a moment with the one before, isometry compares it with the first. Who is whose
neighbour is settled at the first moment, for good. The comparisons are those of the terms of the
loss; here they are made once for a step rather than for each view, and of tracks alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.options.sequences import StreamOptions
from gsdmsr_cli.training.losses import isometry, rigidity, rotation_similarity
from gsdmsr_cli.training.losses._neighbours import Neighbourhoods, NeighbourTerm


@dataclass(frozen=True, eq=False)
class Graph:
    """The K neighbours of each of N splats.

    Attributes:
        near: (N, K) int64; a splat may be among its own, which adds nothing.
        weights: (N, K), less the further away; 0 for itself.
        size: (), root mean square of the distances [world units].
    """

    near: Tensor
    weights: Tensor
    size: Tensor

    def of(self, rows: Tensor) -> Neighbourhoods:
        """Return the neighbourhoods of some splats (S,), whose weights add up to 1."""
        weights = self.weights[rows]
        return Neighbourhoods(rows, self.near[rows], weights / weights.sum(), self.size)


@torch.no_grad()
def graph_of(means: Tensor, count: int) -> Graph | None:
    """Return the neighbours of splats at ``means`` (N, 3), or None if there are not two splats.

    Up to ``count`` of each. The weight at the distance d is exp(-d^2 / (2 size^2)), equation 5 of
    the paper with a width that follows the spacing of the splats.
    """
    kept = min(count + 1, len(means))
    if kept < 2:
        return None
    guesses = torch.zeros(len(means), kept, dtype=torch.int32, device=means.device)
    near = nearest_points(means, means, guesses).long()
    squares = (means[near] - means[:, None]).square().sum(dim=2)
    others = near != torch.arange(len(means), device=means.device)[:, None]
    mean = (squares * others).sum() / others.sum()
    mean = mean.clamp(min=torch.finfo(mean.dtype).tiny)
    return Graph(near, torch.exp(-squares / (2 * mean)) * others, mean.sqrt())


class Compared(NamedTuple):
    """The same N splats at three moments: the newest, the one before, and the first."""

    now: Splats
    before: Splats
    first: Splats


class Stiffness:
    """The weighted sum of what the preset asks for.

    Attributes:
        options: see ``rigidity``, ``rotation_similarity``, ``isometry``, ``neighbours`` and
            ``samples`` there.
    """

    def __init__(self, options: StreamOptions) -> None:
        self.options = options
        kinds: list[tuple[float, NeighbourTerm, str]] = [
            (options.rigidity, rigidity.start(rigidity.Options()), "before"),
            (
                options.rotation_similarity,
                rotation_similarity.start(rotation_similarity.Options()),
                "before",
            ),
            (options.isometry, isometry.start(isometry.Options()), "first"),
        ]
        self._terms = [(factor, term, other) for factor, term, other in kinds if factor > 0]
        self._graph: Graph | None = None

    def __bool__(self) -> bool:
        """Whether anything is asked for."""
        return bool(self._terms)

    def __call__(self, compared: Compared, generator: torch.Generator) -> Tensor | None:
        """Return the sum (), of splats chosen at random; None where there are no neighbours.

        Neighbours are looked for at the first call, which makes that one slow.
        """
        if self._graph is None:
            self._graph = graph_of(compared.first.means.detach(), self.options.neighbours)
        if self._graph is None:
            return None
        count = len(compared.first)
        rows = torch.randperm(count, generator=generator)[: self.options.samples]
        found = self._graph.of(rows.to(self._graph.near.device))
        total = compared.now.means.new_zeros(())
        for factor, term, other in self._terms:
            wrong = term.deviations(compared.now, getattr(compared, other), found)
            total = total + factor * (found.weights * wrong).sum()
        return total
