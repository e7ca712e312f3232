"""Fits the codebooks of the layer ``quantise``, once (Compact 3DGS, Lee et al., CVPR 2024)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population

_LAYER = "quantise"


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        at: progress from which splats are drawn as they are stored; the paper does so for the last
            thirtieth of its steps.
    """

    at: float = 0.8

    def __post_init__(self) -> None:
        require(self, "at", 0 <= self.at <= 1, "0 to 1")


class Codebooks(Event):
    """Happens once, as training passes a value of progress.

    Attributes:
        done: whether it has happened.
    """

    def __init__(self, options: Options) -> None:
        self.options, self.done = options, False

    def due(self, tick: Tick) -> bool:
        """Return whether the value has been passed."""
        return not self.done and tick.progress >= self.options.at

    def apply(self, population: Population, tick: Tick) -> None:
        """Fit the codebooks; averages of splats that were drawn otherwise no longer hold."""
        self.done = True
        splats = population.model.splats.detach()
        for layer in population.model.layers.values():
            layer.fit(splats, population.generator)
        population.average.clear()

    def state(self) -> dict[str, Any]:
        """Return whether it has happened."""
        return {"done": self.done}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.done = bool(state["done"])


def start(options: Options, preset: Preset) -> Codebooks:
    """Return the event.

    Raises:
        UsageError: the preset has no such layer.
    """
    if not any(settings["name"] == _LAYER for settings in preset.layers):
        raise UsageError(
            f"events names 'codebooks', but layers has no '{_LAYER}'; add it, or drop the event"
        )
    return Codebooks(options)
