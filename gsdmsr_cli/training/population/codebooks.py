"""Fits the codebooks of the layer ``quantise``, once (Compact 3DGS, Lee et al., CVPR 2024)."""

from __future__ import annotations

from dataclasses import dataclass

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.population._once import Once
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


class Codebooks(Once):
    """Happens once, as training passes a value of progress."""

    def apply(self, population: Population, tick: Tick) -> None:
        """Fit the codebooks; averages of splats that were drawn otherwise no longer hold."""
        self.done = True
        splats = population.model.splats.detach()
        for layer in population.model.layers.values():
            layer.fit(splats, population.generator)
        population.average.clear()


def start(options: Options, preset: Preset) -> Codebooks:
    """Return the event.

    Raises:
        UsageError: the preset has no such layer.
    """
    if not any(settings["name"] == _LAYER for settings in preset.layers):
        raise UsageError(
            f"events names 'codebooks', but layers has no '{_LAYER}'; add it, or drop the event"
        )
    return Codebooks(options.at)
