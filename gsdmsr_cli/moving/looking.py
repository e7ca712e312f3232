"""Looks at a model at many times: what its splats are then, one way of writing them for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.moving.playing import UNSEEN, exponents_of
from gsdmsr_cli.moving.shapes import rotations_and_scales

FAINTEST = 1e-3
"""Where a life leaves less of its opacity, it does not show how opaque the splat would be."""

Samples = Mapping[str, Tensor]
"""Splats at T times: means, quats, log_scales, opacities and sh, (T, M, C) each."""

_NAMES = "means", "quats", "log_scales", "opacities", "sh"


def at(model: Model, time: float) -> Moment:
    """Return what is drawn of a model that needs no camera at a time in [0, 1]."""
    return model.at(model.instant(time))


def look(model: Model, times: Sequence[float], moving: int) -> tuple[Samples, Splats]:
    """Return the splats that move at all times, and the others."""
    found: dict[str, list[Tensor]] = {}
    first: Tensor | None = None
    for time in times:
        moment = at(model, time).detach()
        quats, log_scales = rotations_and_scales(moment, first)
        first = quats
        splats = moment.splats
        opacities = splats.logit_opacities.sigmoid()[:, None]
        seen = splats.means, quats, log_scales, opacities, splats.sh.flatten(1)
        for name, tensor in zip(_NAMES, seen, strict=True):
            add(found.setdefault(name, []), tensor[:moving])
    still = replace(splats, quats=quats, log_scales=log_scales).map(lambda tensor: tensor[moving:])
    return {name: stacked(tensors) for name, tensors in found.items()}, still


def add(tensors: list[Tensor], tensor: Tensor) -> None:
    """Append a tensor, or once more the first one if it is the same: that takes no memory."""
    same = bool(tensors) and torch.equal(tensors[0], tensor)
    tensors.append(tensors[0] if same else tensor)


def stacked(tensors: Sequence[Tensor]) -> Tensor:
    """Return the tensors as one, (T, M, C)."""
    if all(tensor is tensors[0] for tensor in tensors):
        return tensors[0].expand(len(tensors), *tensors[0].shape)
    return torch.stack(list(tensors))


def without_lives(samples: Samples, lives: Tensor | None, times: Sequence[float]) -> Samples:
    """Return the samples with the opacities that lives take from, where these leave enough."""
    if lives is None:
        return samples
    left = torch.stack([torch.exp(-exponents_of(lives, time)) for time in times])[:, :, None]
    known = left >= FAINTEST
    opacities = torch.where(known, samples["opacities"] / left.clamp(min=FAINTEST), 0.0)
    mean = opacities.sum(dim=0) / known.sum(dim=0).clamp(min=1)
    return {**samples, "opacities": torch.where(known, opacities, mean).clamp(max=1.0)}


def in_the_mean(samples: Samples) -> Splats:
    """Return splats as they are in the mean over time."""
    means, quats, log_scales, opacities, sh = (samples[name].mean(dim=0) for name in _NAMES)
    middle = samples["quats"][len(samples["quats"]) // 2]
    gone = quats.norm(dim=1, keepdim=True) < 0.1  # turned all the way round
    logits = opacities[:, 0].clamp(UNSEEN, 1 - UNSEEN).logit()
    quats = torch.where(gone, middle, quats)
    return Splats(means, quats, log_scales, logits, sh.unflatten(1, (-1, 3)))
