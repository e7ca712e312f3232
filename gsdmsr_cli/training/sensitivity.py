"""How much the pictures would change if a splat did, and which splats matter least by that.

After SpeeDe3DGS (Tu et al. 2025): squared gradients of the pixels, summed over views, with splats
where they are at each view's time. There they are by the weight of a splat's contribution; here
by its position and size, as PUP 3D-GS takes them for scenes that stand still (Hanson et al. 2025).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.model import Model
from gsdmsr_cli.raster import Engine

MOST_VIEWS = 60
"""Views that are looked at; a capture with more is sampled."""


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
    expectation (Bekas, Kokiopoulou & Saad 2007). Steps of the mean count in units of the splat's
    own scales, as those of the log scales do, so that neither depends on the unit of the world.

    Args:
        model: of N splats.
        engine: draws them.
        shots: cameras, and the times at which they see the scene.
        background: (3,) colour behind the splats.
        generator: source of the signs.
    """
    total = torch.zeros(len(model.splats), device=background.device)
    for camera, time in shots:
        with torch.no_grad():
            moment = model.at(time).detach()
        asked = [moment.means.requires_grad_(), moment.log_scales.requires_grad_()]
        picture = engine.rasterize(moment, camera, background).rgb
        signs = 2 * torch.randint(0, 2, picture.shape, generator=generator) - 1
        means, log_scales = torch.autograd.grad(picture, asked, signs.to(picture))
        sizes = moment.log_scales.detach().exp()
        total += (means * sizes).square().sum(dim=1) + log_scales.square().sum(dim=1)
    return total


def most_sensitive(scores: Tensor, share: float) -> Tensor:
    """Return the rows that stay, ascending, when this share of the least scores goes.

    Scores that are not finite go first.
    """
    leaving = int(len(scores) * share)
    order = scores.nan_to_num(0.0, 0.0, 0.0).argsort(stable=True)
    return order[leaving:].sort().values
