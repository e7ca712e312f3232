"""Lowers all opacities now and then, so that useless splats can be pruned (3DGS, section 5.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.model import STORED_AS
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population


@dataclass(frozen=True)
class Options:
    """None of its own: see ``DensityOptions.reset_at`` and ``reset_opacity``."""


class OpacityReset(Event):
    """Happens as training passes each of the listed values of progress.

    Attributes:
        count: how many times it has happened.
    """

    def __init__(self, reset_at: tuple[float, ...], opacity: float) -> None:
        """Lower opacities to ``opacity`` each time."""
        self.reset_at, self.opacity = reset_at, opacity
        self.count = 0

    def due(self, tick: Tick) -> bool:
        """Return whether the next value has been passed."""
        return self.count < len(self.reset_at) and tick.progress >= self.reset_at[self.count]

    def apply(self, population: Population, tick: Tick) -> None:
        """Lower the opacities; their moments, and averages, no longer hold."""
        self.count += 1
        reset_opacities(population.model.splats, self.opacity)
        population.optimizer.reset_moments(STORED_AS + "logit_opacities")
        population.average.clear()
        population.saliency.restart(torch.ones_like(population.saliency.high))

    def state(self) -> dict[str, Any]:
        """Return how often it has happened."""
        return {"count": self.count}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.count = int(state["count"])


def start(options: Options, preset: Preset) -> OpacityReset:
    """Return resets as the preset wants them."""
    return OpacityReset(preset.density.reset_at, preset.density.reset_opacity)


@torch.no_grad()
def reset_opacities(splats: Splats, opacity: float) -> None:
    """Lower every opacity to this one at most, in place, so that useless splats can be pruned."""
    splats.logit_opacities.clamp_(max=math.log(opacity / (1 - opacity)))
