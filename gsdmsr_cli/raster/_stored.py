"""Prepares a moment's tensors for the kernels of an engine."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment


def stored_of(moment: Moment) -> list[Tensor | None]:
    """Return means, quats, log_scales, logit_opacities, sh and axes, contiguous, None if not read.

    Splats with a feature that is not finite get the opacity 0, so that kernels, which project
    without the features, do not draw them.
    """
    splats = moment.splats
    logits = splats.logit_opacities
    if moment.features is not None:
        logits = logits.where(moment.features.isfinite().all(dim=1), -math.inf)
    shape = (splats.quats, splats.log_scales) if moment.axes is None else (None, None)
    tensors = splats.means, *shape, logits, splats.sh, moment.axes
    return [None if tensor is None else tensor.contiguous() for tensor in tensors]


def in_groups(features: Tensor, size: int) -> tuple[Tensor, ...]:
    """Return (N, F) features as parts (N, size); zeros fill up the last one."""
    filled = torch.nn.functional.pad(features, (0, -features.shape[1] % size))
    return torch.split(filled, size, dim=1)


def refuse_features(moment: Moment) -> None:
    """Raise ValueError if there are features: they are decoded between drawing and comparing."""
    if moment.features is not None:
        raise ValueError(
            "a moment with features is drawn by rasterize and compared afterwards, not by compare"
        )
