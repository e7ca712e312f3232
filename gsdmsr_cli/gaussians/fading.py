"""Opacities that a factor makes smaller, as logits: how splats appear and vanish in time."""

from __future__ import annotations

import torch
from torch import Tensor

MOST = 80.0
"""Logits and exponents count up to this size: exp(80) is finite, exp(-80) far below any alpha."""


def fade(logit_opacities: Tensor, exponents: Tensor) -> Tensor:
    """Return the logits (N,) of the opacities times exp(-exponents).

    With the opacity s = 1 / (1 + exp(-l)) and the factor g = exp(-e), logit(s g) is
    -e - log(1 - g + exp(-l)), which is exact for opacities near 0 and 1 as well, and l where e = 0.

    Args:
        logit_opacities: (N,) l.
        exponents: (N,) e, 0 or more.
    """
    exponents = exponents.clamp(max=MOST)
    inverse = torch.exp(-logit_opacities.clamp(-MOST, MOST))
    return -exponents - torch.log(inverse - torch.expm1(-exponents))


def thin(logit_opacities: Tensor, share: float) -> Tensor:
    """Return the logits (N,) of opacities with a share of the optical depth.

    The opacity s becomes 1 - (1 - s)^w. Splats with shares that add up to 1 at the same place let
    through what one splat with all of it does. With the depth d = -w log(1 - s), which is w
    softplus(l), the new logit is log(exp(d) - 1).

    Args:
        logit_opacities: (N,) l.
        share: w, above 0, at most 1.
    """
    depths = share * torch.nn.functional.softplus(logit_opacities.clamp(-MOST, MOST))
    depths = depths.clamp(min=torch.finfo(depths.dtype).tiny)
    return depths + torch.log(-torch.expm1(-depths))
