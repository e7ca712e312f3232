"""Finds the splats that move so little that they may as well stand still.

The motion signal of GS-DMSR's saliency (Lu et al. 2026, section 4.1): a property of the model at
different moments, where the optimiser's signal is one of a step of the training.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.geometry import SH_C0
from gsdmsr_cli.model import Model
from gsdmsr_cli.splats import NAMES, Splats

MOMENTS = 16
"""Times, evenly spaced, at which splats are looked at."""


@torch.no_grad()
def motion_saliency(model: Model) -> tuple[Tensor, Splats]:
    """Return how much each splat moves (N,), and the splats at the mean of their moments.

    A splat's saliency is the largest deviation from that mean over the moments: of its centre, in
    units of the geometric mean of its scales; of its log scales; of its rotation, as an angle
    [rad]; of its logit of opacity and of its colour.
    """
    moments = [model.at(i / (MOMENTS - 1)) for i in range(MOMENTS)]
    mean = Splats(**{name: _mean(name, moments) for name in NAMES})
    size = mean.log_scales.mean(dim=1).exp()
    saliency = mean.means.new_zeros(len(mean))
    for moment in moments:
        parts = (
            (moment.means - mean.means).norm(dim=1) / size,
            (moment.log_scales - mean.log_scales).abs().amax(dim=1),
            _angle(moment.quats, mean.quats),
            (moment.logit_opacities - mean.logit_opacities).abs(),
            SH_C0 * (moment.sh - mean.sh).abs().flatten(1).amax(dim=1),
        )
        saliency = torch.stack([saliency, *parts]).amax(dim=0)
    return saliency, mean


def _mean(name: str, moments: list[Splats]) -> Tensor:
    return torch.stack([getattr(moment, name) for moment in moments]).mean(dim=0)


def _angle(first: Tensor, second: Tensor) -> Tensor:
    """Return the angle between two rotations (N, 4) [rad]."""
    unit = torch.nn.functional.normalize
    # of |a - b| and |a + b| the smaller one is to the nearer of the two quaternions of a rotation;
    # an arc cosine would lose small angles
    a, b = unit(first, dim=1), unit(second, dim=1)
    chord = torch.minimum((a - b).norm(dim=1), (a + b).norm(dim=1))
    return 4 * torch.asin((chord / 2).clamp(max=1))
