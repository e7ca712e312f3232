"""Lets splats stand still that show nothing of what the scene's masks say moves.

A capture with one camera does not say whether a splat of the ground stands or follows what goes
past it. Masks of what moves do, such as those of ``prepare --auto-mask``: what a splat adds to the
pixels inside them, over what it adds to all pixels of a view, is how much of it moves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.strict import require, require_progress
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.scene import MOVING, View
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population, Resize
from gsdmsr_cli.training.standing import let_stand_still, mean_of_moments, of_moving_layers

LEAST = 0.5
"""Pixels that a splat must cover in all views together for something to be known of it."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        rounds: how many times it is looked for, spread evenly over progress.
        until: progress at which that ends.
        views: train views that are looked at in a round, chosen at random.
        margin: by which masks are grown, since they end early [share of the longer side].
        still_below: share of what a splat shows inside the masks below which it is to stand still.
        moving_above: share above which it is to move again.
    """

    rounds: int = 12
    until: float = 0.7
    views: int = 12
    margin: float = 0.02
    still_below: float = 0.05
    moving_above: float = 0.3

    def __post_init__(self) -> None:
        require(self, "rounds", self.rounds >= 1, "1 or more")
        require(self, "views", self.views >= 1, "1 or more")
        require(self, "margin", 0 <= self.margin <= 0.5, "a share from 0 to 0.5")
        require(self, "still_below", 0 <= self.still_below <= 1, "a share from 0 to 1")
        within = self.still_below <= self.moving_above <= 1
        require(self, "moving_above", within, "a share from still_below to 1")
        require_progress(self, "until")


class MotionMasks(Event):
    """Happens as motion begins, and then from time to time.

    Attributes:
        rounds: how many times it has happened.
    """

    def __init__(self, options: Options, first: float) -> None:
        self.options, self.first = options, first
        self.rounds = 0

    def begin(self, views: Sequence[View]) -> str | None:
        """Return what to do for masks where no view has one."""
        if any(MOVING in view.signals for view in views):
            return None
        return (
            "no train view has a mask of what moves, so everything may move: prepare --auto-mask "
            "makes such masks, and what stands is then kept apart from what moves"
        )

    def due(self, tick: Tick) -> bool:
        """Return whether the next round's turn has come."""
        o = self.options
        at = self.first + (o.until - self.first) * self.rounds / o.rounds
        return self.rounds < o.rounds and at <= tick.progress < o.until

    def apply(self, population: Population, tick: Tick) -> Resize | None:
        """Let splats outside the masks stand still, and those inside of them move again."""
        if not population.moving:
            return None
        self.rounds += 1
        seen = population.marked(self.options.views)
        if not seen:
            return None
        model = population.model
        with population.all_threads():
            inside, total = shown_inside(
                model, population.engine, seen, population.background, self.options.margin
            )
        share, known = inside / total.clamp(min=1e-9), total > LEAST
        still = known & (share < self.options.still_below)
        rows = torch.arange(len(still), device=still.device)
        again = known & (share > self.options.moving_above) & (rows >= model.moving)
        camera = seen[0][0] if model.needs_camera else None
        change = let_stand_still(model, still, mean_of_moments(of_moving_layers(model), camera))
        return replace(change, moving=again) if again.any() else change

    def state(self) -> dict[str, Any]:
        """Return how often it has happened."""
        return {"rounds": self.rounds}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.rounds = int(state["rounds"])


def start(options: Options, preset: Preset) -> MotionMasks:
    """Return the event as the preset wants it."""
    return MotionMasks(options, preset.training.static_until)


def shown_inside(
    model: Model,
    engine: Engine,
    seen: Sequence[tuple[Camera, float, Tensor]],
    background: Tensor,
    margin: float,
) -> tuple[Tensor, Tensor]:
    """Return how many pixels each splat covers inside the masks, and how many at all, (N,) each.

    A pixel counts by the weight with which the splat is blended there, summed over the views.

    Args:
        model: of N splats.
        engine: draws them.
        seen: cameras, times, and (H, W) bool, true where something moves.
        background: (3,) colour behind the splats.
        margin: by which masks are grown [share of the longer side].
    """
    inside, total = (torch.zeros(len(model.splats), device=background.device) for _ in range(2))
    for camera, time, mask in seen:
        with torch.no_grad():
            moment = model.at(model.instant(time, camera)).detach()
        # what a pixel is worth to a splat's colour is the weight with which it is blended there
        plain = moment.splats.sh.new_zeros(len(inside), 1, 3).requires_grad_()
        moment = replace(moment, splats=replace(moment.splats, sh=plain))
        frame = engine.rasterize(moment, camera, background, 0)
        grown = _grown(mask, margin).to(frame.rgb)
        asked = torch.stack([grown, torch.ones_like(grown), torch.zeros_like(grown)], dim=2)
        (weights,) = torch.autograd.grad(frame.rgb, plain, asked)
        inside += weights[:, 0, 0]
        total += weights[:, 0, 1]
    return inside / SH_C0, total / SH_C0


def _grown(mask: Tensor, margin: float) -> Tensor:
    reach = math.ceil(margin * max(mask.shape))
    if not reach:
        return mask
    wide = torch.nn.functional.max_pool2d(
        mask[None, None].float(), (2 * reach + 1, 1), 1, (reach, 0)
    )
    return torch.nn.functional.max_pool2d(wide, (1, 2 * reach + 1), 1, (0, reach))[0, 0] > 0
