"""Lets splats of a model stand still, at the mean of the moments that they go through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.resizing import Resize, kept

MOMENTS = 16
"""Times, evenly spaced, at which splats are compared."""


@torch.no_grad()
def let_stand_still(model: Model, still: Tensor, where: Splats) -> Resize:
    """Return the resize after which further splats stand still.

    Args:
        model: of N splats.
        still: (N,) bool, those that are to stand still; ones that do already may be named.
        where: N splats, whose values those take that begin to.
    """
    rows = torch.arange(len(still), device=still.device)
    begin = still & (rows < model.moving)
    splats = {
        name: torch.where(begin.view(-1, *[1] * (tensor.dim() - 1)), getattr(where, name), tensor)
        for name, tensor in model.splats.detach().tensors().items()
    }
    return replace(kept(rows), splats=Splats(**splats), still=still)


def of_moving_layers(model: Model) -> Model:
    """Return the model with the layers alone that do not concern splats that stand still."""
    layers = {name: own for name, own in model.layers.items() if not own.concerns_still}
    return Model(model.splats, layers, model.moving, model.precision)


def moments_of(model: Model, camera: Camera | None) -> Iterator[Splats]:
    """Return the splats at each of the moments, one after the other: together they are large."""
    times = (i / (MOMENTS - 1) for i in range(MOMENTS))
    return (model.at(model.instant(time, camera)).splats for time in times)


@torch.no_grad()
def mean_of_moments(model: Model, camera: Camera | None) -> Splats:
    """Return the mean of the moments, by what they are away from the first: what stays, stays."""
    moments = moments_of(model, camera)
    first = next(moments)
    ways = {name: torch.zeros_like(tensor) for name, tensor in first.tensors().items()}
    for moment in moments:
        for name, tensor in moment.tensors().items():
            ways[name] += tensor - getattr(first, name)
    return Splats(**{name: getattr(first, name) + way / MOMENTS for name, way in ways.items()})
