"""Removes the splats that the pictures depend on least.

After SpeeDe3DGS (Tu et al. 2025): squared gradients of the pixels, summed over views, with splats
where they are at each view's time. There they are by the weight of a splat's contribution; here
by its position and size, as PUP 3D-GS takes them for scenes that stand still (Hanson et al. 2025).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population, Resize, kept

MOST_VIEWS = 60
"""Views that are rendered; a capture with more is sampled."""


@dataclass(frozen=True)
class Options:
    """None of its own: see ``DensityOptions.thin_at`` and ``thin_share``."""


class Thinning(Event):
    """Happens as training passes each of the listed values of progress.

    Attributes:
        count: how many times it has happened.
    """

    def __init__(self, thin_at: tuple[float, ...], thin_share: float) -> None:
        self.thin_at, self.thin_share = thin_at, thin_share
        self.count = 0

    def due(self, tick: Tick) -> bool:
        """Return whether the next value has been passed."""
        return self.count < len(self.thin_at) and tick.progress >= self.thin_at[self.count]

    def apply(self, population: Population, tick: Tick) -> Resize:
        """Prune the splats that the training's pictures depend on least."""
        self.count += 1
        shots = population.shots(MOST_VIEWS)
        given = population.engine, shots, population.background, population.generator
        with population.all_threads():
            scores = picture_sensitivity(population.model, *given)
        return kept(most_sensitive(scores, self.thin_share))

    def state(self) -> dict[str, Any]:
        """Return how often it has happened."""
        return {"count": self.count}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned; there was no such event at first."""
        self.count = int(state.get("count", 0))


def start(options: Options, preset: Preset) -> Thinning:
    """Return thinnings as the preset wants them."""
    return Thinning(preset.density.thin_at, preset.density.thin_share)


def picture_sensitivity(
    model: Model,
    engine: Engine,
    shots: Sequence[tuple[Camera, float]],
    background: Tensor,
    generator: torch.Generator,
) -> Tensor:
    """Return (N,) the squared gradient of the pictures by each splat's mean and log scales.

    It is the trace over these six parameters of JᵀJ, J the Jacobian of all pixels of all pictures.
    Its diagonal is estimated with one vector of random signs v a picture, whose (Jᵀv)² has that
    expectation (Bekas, Kokiopoulou & Saad 2007). Steps of the mean count along the splat's own axes
    and in units of its scales, as those of the log scales do, so that neither depends on the unit
    or the directions of the world.

    Args:
        model: of N splats.
        engine: draws them.
        shots: cameras, and the times at which they see the scene.
        background: (3,) colour behind the splats.
        generator: source of the signs.
    """
    total = torch.zeros(len(model.splats), device=background.device)
    for camera, time in shots:
        instant = model.instant(time, camera)
        with torch.no_grad():
            moment = model.at(instant).detach()
        splats, axes = moment.splats, moment.axes
        extents = splats.log_scales if axes is None else axes
        asked = [splats.means.requires_grad_(), extents.requires_grad_()]
        frame = engine.rasterize(moment, camera, background)
        picture = model.shade(frame, instant).rgb
        signs = 2 * torch.randint(0, 2, picture.shape, generator=generator) - 1
        means, slopes = torch.autograd.grad(picture, asked, signs.to(picture))
        with torch.no_grad():
            if axes is None:
                axes, by_scale = scaled_axes(splats.quats, extents), slopes
            else:  # columns of A are axes; to scale one by e^s changes A by s times that column
                by_scale = (slopes * axes).sum(dim=1)
            by_mean = (axes * means[:, :, None]).sum(dim=1)  # Aᵀ times the gradient
            total += by_mean.square().sum(dim=1) + by_scale.square().sum(dim=1)
    return total


def most_sensitive(scores: Tensor, share: float) -> Tensor:
    """Return the rows that stay, ascending, when this share of the least scores goes.

    Scores that are not finite go first.
    """
    leaving = int(len(scores) * share)
    order = scores.nan_to_num(0.0, 0.0, 0.0).argsort(stable=True)
    return order[leaving:].sort().values
