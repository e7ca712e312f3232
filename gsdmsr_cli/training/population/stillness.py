"""Finds the splats that hardly move, and lets them stand still.

The motion signal of GS-DMSR's saliency (Lu et al. 2026, section 4.1): a property of the model at
different moments, where the optimiser's signal is one of a step of the training.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import Preset, SaliencyOptions
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population, Resize
from gsdmsr_cli.training.standing import (
    let_stand_still,
    mean_of_moments,
    moments_of,
    of_moving_layers,
)


@dataclass(frozen=True)
class Options:
    """None of its own: see ``SaliencyOptions.still_from`` and those after it."""


class Stillness(Event):
    """Lets splats stand still that hardly move; not while splats are grown or averaged."""

    def __init__(self, options: SaliencyOptions, first: float, last: float) -> None:
        self.options, self.first, self.last = options, first, last

    def due(self, tick: Tick) -> bool:
        """Return whether to search for such splats after this step."""
        now = self.first <= tick.progress < self.last
        return now and tick.step % self.options.still_every == 0

    def apply(self, population: Population, tick: Tick) -> Resize:
        """Leave splats that hardly move at the mean of where they are."""
        model = population.model
        camera = population.shots(1)[0][0] if model.needs_camera else None
        saliency, mean = motion_saliency(model, camera)
        return let_stand_still(model, saliency < self.options.still_below, mean)


def start(options: Options, preset: Preset) -> Stillness:
    """Return the search as the preset wants it."""
    saliency = preset.saliency
    first = max(saliency.still_from, preset.density.until)
    return Stillness(saliency, first, preset.training.average_from)


@torch.no_grad()
def motion_saliency(model: Model, camera: Camera | None = None) -> tuple[Tensor, Splats]:
    """Return how much each splat moves (N,), and the splats at the mean of their moments.

    A splat's saliency is the largest deviation from that mean over the moments: of its centre, in
    units of the geometric mean of its scales; of its log scales; of its rotation, as an angle
    [rad]; of its logit of opacity and of its colour. Layers that concern splats that stand still as
    well have no part in this: what they do, they go on doing.

    Args:
        model: of N splats.
        camera: that looks at all moments, for layers that want one.
    """
    model = of_moving_layers(model)
    mean = mean_of_moments(model, camera)
    size = mean.log_scales.mean(dim=1).exp()
    saliency = mean.means.new_zeros(len(mean))
    for moment in moments_of(model, camera):
        parts = (
            (moment.means - mean.means).norm(dim=1) / size,
            (moment.log_scales - mean.log_scales).abs().amax(dim=1),
            _angle(moment.quats, mean.quats),
            (moment.logit_opacities - mean.logit_opacities).abs(),
            SH_C0 * (moment.sh - mean.sh).abs().flatten(1).amax(dim=1),
        )
        saliency = torch.stack([saliency, *parts]).amax(dim=0)
    return saliency, mean


def _angle(first: Tensor, second: Tensor) -> Tensor:
    """Return the angle between two rotations (N, 4) [rad]."""
    unit = torch.nn.functional.normalize
    # of |a - b| and |a + b| the smaller one is to the nearer of the two quaternions of a rotation;
    # an arc cosine would lose small angles
    a, b = unit(first, dim=1), unit(second, dim=1)
    chord = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))
    return 4 * torch.asin((chord / 2).clamp(max=1))
