"""Removes the splats that the layer ``mask`` hides (Compact 3DGS, Lee et al., CVPR 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population, Resize, kept

_LAYER = "mask"


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        every: interval [steps].
    """

    every: int = 100

    def __post_init__(self) -> None:
        require(self, "every", self.every >= 1, "1 or more")


class Masked(Event):
    """Happens at an interval, and where all are hidden not at all."""

    def __init__(self, options: Options) -> None:
        self.options = options

    def due(self, tick: Tick) -> bool:
        """Return whether the interval has passed."""
        return tick.step % self.options.every == 0

    def apply(self, population: Population, tick: Tick) -> Resize | None:
        """Keep the splats that are drawn."""
        count = len(population.model.splats)
        shown = torch.ones(count, dtype=torch.bool, device=population.background.device)
        for layer in population.model.layers.values():
            own = layer.kept()
            if own is not None:
                shown[: len(own)] &= own
        rows = shown.nonzero().flatten()
        return kept(rows) if 0 < len(rows) < count else None


def start(options: Options, preset: Preset) -> Masked:
    """Return the event.

    Raises:
        UsageError: the preset has no such layer.
    """
    if not any(settings["name"] == _LAYER for settings in preset.layers):
        raise UsageError(f"events names 'masked', but layers has no '{_LAYER}'; add it, or drop it")
    return Masked(options)
