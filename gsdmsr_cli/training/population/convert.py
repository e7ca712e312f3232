"""Makes the splats dynamic that drift the farthest.

Ex4DGS (Lee et al., NeurIPS 2024): a training begins with static splats alone. Now and then the few
per cent of them that go the farthest, as the pictures see it, get a motion of their own. Here
static splats are those that stand still: they go through layers that concern these too, such as
``drift``, and not through the motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population, Resize, kept

LEAST = 1e-6
"""What goes less far stays static [scene radii]."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        share: of the static splats that a view shows, those that are made dynamic at a time.
        rounds: how many times, spread evenly over progress.
        start: progress from which that happens.
        until: progress at which it ends.
    """

    share: float = 0.02
    rounds: int = 40
    start: float = 0.05
    until: float = 0.6

    def __post_init__(self) -> None:
        require(self, "share", 0 < self.share <= 1, "above 0, at most 1")
        require(self, "rounds", self.rounds >= 1, "1 or more")
        require(self, "start", 0 <= self.start < 1, "0 or more, below 1")
        require(self, "until", self.start < self.until <= 1, "above start, at most 1")


class Convert(Event):
    """Lets all splats stand still after the first step, and then some of them move.

    Attributes:
        begun: whether all have been let stand still.
        rounds: how many times some have been made dynamic.
    """

    def __init__(self, options: Options) -> None:
        self.options = options
        self.begun, self.rounds = False, 0

    def due(self, tick: Tick) -> bool:
        """Return whether it is the first step, or the next round's turn."""
        o = self.options
        over = tick.progress - o.start - (o.until - o.start) * self.rounds / o.rounds
        return not self.begun or (self.rounds < o.rounds and over >= 0)

    def apply(self, population: Population, tick: Tick) -> Resize | None:
        """Let all splats stand still at first; later make the farthest dynamic."""
        model = population.model
        everything = kept(torch.arange(len(model.splats), device=model.splats.means.device))
        if not self.begun:
            self.begun = True
            return replace(everything, still=torch.ones_like(everything.fresh))
        self.rounds += 1
        ((camera, time),) = population.shots(1)
        ways = apparent_ways(population, camera, time)
        chosen = farthest(ways, self.options.share)
        if not len(chosen):
            return None
        moving = torch.zeros_like(everything.fresh)
        moving[chosen] = True
        return replace(everything, moving=moving)

    def state(self) -> dict[str, Any]:
        """Return how often it has happened."""
        return {"begun": self.begun, "rounds": self.rounds}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.begun, self.rounds = bool(state["begun"]), int(state["rounds"])


def start(options: Options, preset: Preset) -> Convert:
    """Return the event."""
    return Convert(options)


@torch.no_grad()
def apparent_ways(population: Population, camera: Camera, time: float) -> Tensor:
    """Return how far static splats go that a view shows, by the squared distance to it, (N,).

    0 for all others: those that move, that the view does not show, and that go nowhere.
    """
    model = population.model
    moment = model.at(model.instant(time, camera)).detach()
    frame = population.engine.rasterize(moment, camera, population.background)
    ways = _ways(model, camera)
    eye = torch.from_numpy(camera.centre).to(ways)
    counted = (frame.radii > 0) & (ways > LEAST * population.radius)
    counted[: model.moving] = False
    squares = (moment.splats.means - eye).square().sum(dim=1)
    return torch.where(counted, ways / squares, 0.0)


def _ways(model: Model, camera: Camera) -> Tensor:
    """Return how far each splat gets from the first time to the last, (N,) [world units]."""
    first, last = (model.at(model.instant(time, camera)).splats.means for time in (0.0, 1.0))
    lengths: Tensor = (last - first).norm(dim=1)
    return lengths


def farthest(ways: Tensor, share: float) -> Tensor:
    """Return the rows of the largest ways, this share, rounded up, of those that are above 0."""
    count = math.ceil(share * int((ways > 0).sum()))
    return ways.argsort(descending=True, stable=True)[:count]
