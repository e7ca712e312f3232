"""Lets a motion of rigid groups take over from the motion that has been trained so far.

GroupFlow of SpeeDe3DGS (Tu et al., CVPR 2026): half way through a training its trajectories are
clustered, and what is drawn from then on, and trained, is one rigid movement per group.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.distilling import Distilling
from gsdmsr_cli.model.model import STORED
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.strict import require_progress
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.population._once import Once
from gsdmsr_cli.training.resizing import Population


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        at: progress at which it happens; best after splats have ceased to grow.
    """

    at: float = 0.5

    def __post_init__(self) -> None:
        require_progress(self, "at")


class Distil(Once):
    """Happens once, when the splats move."""

    @torch.no_grad()
    def apply(self, population: Population, tick: Tick) -> None:
        """Let layers take over, and splats have the canonical values that these want."""
        if not population.moving:
            return
        self.done = True
        model, optimizer = population.model, population.optimizer
        splats, moving = model.splats.detach(), slice(0, model.moving)
        for key, layer in model.layers.items():
            if isinstance(layer, Distilling):
                own, dropped = layer.distil(splats.map(lambda tensor: tensor[moving]))
                for name, values in own.tensors().items():
                    splats.tensors()[name][moving] = values
                for name in dropped:
                    optimizer.forget(f"{key}.{name}")
        for name in STORED:
            optimizer.reset_moments(name, second=False)
        population.average.clear()


def start(options: Options, preset: Preset) -> Distil:
    """Return the event.

    Raises:
        UsageError: the preset's motion has no base to take over from.
    """
    motion = preset.motion
    if not motion.get("base"):
        raise UsageError(
            f"events names 'distil', but the motion '{motion['name']}' has no base to take over "
            "from; write motion: {name: rigid_groups, base: {name: "
            f"{motion['name']}}}}}"
        )
    return Distil(options.at)
