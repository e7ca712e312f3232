"""Neighbours keep the distance that they have at the first train time (Luiten et al. 2024).

Dynamic 3D Gaussians (3DV 2024), equation 7: weaker than rigidity, but for the whole capture, so
that parts do not drift away from each other little by little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses._comparing import first_time
from gsdmsr_cli.training.losses._neighbours import (
    Neighbourhoods,
    NeighbourOptions,
    NeighbourTerm,
    lengths,
)


@dataclass(frozen=True)
class Options(NeighbourOptions):
    """See ``Schedule`` and ``NeighbourOptions``."""


class Isometry(NeighbourTerm):
    """| |x_j - x_i| - |x_j' - x_i'| |, the prime being the first train time."""

    def other_time(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> float | None:
        """Return the first train time, or None for views of it."""
        return first_time(view.time, times)

    def deviations(self, now: Splats, other: Splats, found: Neighbourhoods) -> Tensor:
        """Return the differences (S, K)."""
        long, before = (lengths(found.apart(one.means)) for one in (now, other))
        return (long - before).abs() / found.size


def start(options: Options) -> Isometry:
    """Return the term."""
    return Isometry(options)
