"""No motion: the splats stay where they are (3DGS)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.motion import Facts
from gsdmsr_cli.splats import Splats


@dataclass(frozen=True)
class Options:
    """Nothing to set."""


class Static:
    """The identity at every time."""

    def at(self, splats: Splats, time: float) -> Splats:
        """Return the splats themselves."""
        return splats

    def take(self, rows: Tensor) -> None:
        """Hold nothing per splat."""

    def advance(self, progress: float) -> None:
        """Have no phases."""

    def penalty(self, splats: Splats, time: float, generator: torch.Generator) -> Tensor | None:
        """Have no regularisers."""
        return None

    def tensors(self) -> dict[str, Tensor]:
        """Have no tensors."""
        return {}

    def groups(self) -> dict[str, str]:
        """Have no learning rates."""
        return {}


def start(options: Options, facts: Facts, count: int, generator: torch.Generator) -> Static:
    """Return the identity."""
    return Static()
