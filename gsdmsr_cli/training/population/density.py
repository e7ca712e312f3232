"""Adaptive density control: clone, split and prune (3DGS, Kerbl et al. 2023, section 5)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.options.preset import DensityOptions, Preset
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import SPLIT_SHRINK, Population, Resize
from gsdmsr_cli.training.statistics import DensityStatistics

PRUNE_EVERY = 500
"""Interval of pruning alone, once growing has ended [steps]."""


@dataclass(frozen=True)
class Options:
    """None of its own: see ``DensityOptions``."""


class Density(Event):
    """Clones, splits and prunes; once growing has ended, prunes what is faint alone.

    Attributes:
        rounds: how many times splats have grown.
    """

    def __init__(self, options: DensityOptions) -> None:
        self.options = options
        self.rounds = 0

    def due(self, tick: Tick) -> bool:
        """Return whether to grow and prune, or only to prune, after this step."""
        o = self.options
        if tick.step < o.start:
            return False
        if not self._growing(tick):
            return tick.step % PRUNE_EVERY == 0
        return tick.step % o.every == 0 and tick.progress * o.rounds >= self.rounds * o.until

    def _growing(self, tick: Tick) -> bool:
        return tick.progress < self.options.until

    def apply(self, population: Population, tick: Tick) -> Resize:
        """Grow and prune.

        Raises:
            GsdmsrError: no splat is left.
        """
        growing = self._growing(tick)
        self.rounds += growing
        model, given = population.model, (population.radius, growing, population.generator)
        options = replace(self.options, gradient=gradient_at(self.options, tick))
        change = grow_and_prune(
            model.splats, population.statistics, options, *given, model.to_split(),
            model.highest_opacities(),
        )  # fmt: skip
        if not len(change.rows):
            raise GsdmsrError(
                f"no splats are left at step {tick.step}; if what moves is small and goes far, "
                "try --set training.window=0.1 --set training.window_if=always; else lower "
                "density.prune_opacity, or check that cameras and pictures belong together"
            )
        population.statistics.clear()
        return change

    def state(self) -> dict[str, Any]:
        """Return how often splats have grown."""
        return {"rounds": self.rounds}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.rounds = int(state["rounds"])


def start(options: Options, preset: Preset) -> Density:
    """Return density control as the preset wants it."""
    return Density(preset.density)


def gradient_at(options: DensityOptions, tick: Tick) -> float:
    """Return the gradient above which a splat grows at a time of a training.

    It falls with the square root of the steps that the training is going to have, judged by those
    that it has made, once these are more than ``long_from``: what more splats cost, a long training
    has the time for.
    """
    if not options.long_from or not tick.progress:
        return options.gradient
    share = options.long_from * tick.progress / tick.step
    return options.gradient * math.sqrt(min(share, 1.0))


@torch.no_grad()
def grow_and_prune(
    splats: Splats,
    statistics: DensityStatistics,
    options: DensityOptions,
    radius: float,
    growing: bool,
    generator: torch.Generator,
    to_split: Tensor | None = None,
    highest: Tensor | None = None,
) -> Resize:
    """Decide which splats go on, and which are cloned and split.

    Args:
        splats: N canonical splats.
        statistics: their gradients since the last call.
        options: thresholds.
        radius: the scene's radius [world units].
        growing: whether splats may be cloned and split, or only pruned.
        generator: source of the split children's positions.
        to_split: (N,) bool, splats that are split if they grow, even if they are small.
        highest: (N,) logits of the most that splats are opaque at any time, if not what is stored.

    Returns:
        which splats there are to be; the children have been moved and shrunk.
    """
    largest = splats.log_scales.exp().amax(dim=1)
    logits = splats.logit_opacities if highest is None else highest
    kept = torch.sigmoid(logits) >= options.prune_opacity
    if growing:  # later nothing would take the place of a large splat, which may be a wall
        kept &= largest <= options.prune_scale * radius
    for tensor in splats.tensors().values():
        kept &= tensor.isfinite().reshape(len(splats), -1).all(dim=1)
    wanted = _chosen(statistics, options, int(kept.sum())) if growing else torch.zeros_like(kept)
    grows = kept & wanted
    large = largest > options.split_scale * radius
    split = grows & (large if to_split is None else large | to_split)
    survivors, clones = kept & ~split, grows & ~split
    children = split.nonzero().flatten().repeat(2)
    rows = torch.cat([survivors.nonzero().flatten(), clones.nonzero().flatten(), children])
    fresh = torch.arange(len(rows), device=rows.device) >= int(survivors.sum())
    grown = splats.detach().take(rows)
    if len(children):
        _scatter_children(grown, len(children), generator)
    born = torch.arange(len(rows), device=rows.device) >= len(rows) - len(children)
    return Resize(rows, fresh, grown, split=born)


def _chosen(statistics: DensityStatistics, options: DensityOptions, kept: int) -> Tensor:
    """Return which splats have a large gradient, the largest first if the cap leaves few places."""
    mean = statistics.mean()
    chosen = mean >= options.gradient
    room = max(options.cap - kept, 0)
    if int(chosen.sum()) > room:
        best = mean.argsort(descending=True, stable=True)[:room]
        chosen = torch.zeros_like(chosen)
        chosen[best] = True
    return chosen


def _scatter_children(grown: Splats, count: int, generator: torch.Generator) -> None:
    """Draw the last ``count`` means from their parents' Gaussians and shrink them, in place."""
    children = slice(len(grown) - count, None)
    scales = grown.log_scales[children].exp()
    noise = torch.randn(count, 3, generator=generator).to(scales) * scales
    turned = quat_to_rotmat(grown.quats[children]) @ noise[:, :, None]
    grown.means[children] += turned[:, :, 0]
    grown.log_scales[children] -= math.log(SPLIT_SHRINK)
