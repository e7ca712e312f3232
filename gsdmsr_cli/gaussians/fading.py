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
