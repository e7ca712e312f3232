"""Lets a layer act on some rows of what is drawn, or learn from some rows alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.model.layer import Instant, Layer


def apply(layer: Layer, moments: Sequence[Moment], instants: Sequence[Instant]) -> list[Moment]:
    """Return the moments after a layer, by ``at_instants`` where all are the same one."""
    if len(set(moments)) == 1 and len(instants) > 1:
        return layer.at_instants(moments[0], instants)
    return layer.at_moments(moments, instants)


def split(moment: Moment, count: int) -> tuple[Moment, Moment]:
    """Return the first ``count`` rows of a moment and the others, both without a copy."""
    sizes = [count, len(moment) - count]
    splats = {name: t.split(sizes) for name, t in moment.splats.tensors().items()}
    given = moment.axes, moment.features, moment.canonical_quats
    further = [None if t is None else t.split(sizes) for t in given]
    first, rest = (
        Moment(
            Splats(**{name: both[i] for name, both in splats.items()}),
            *(None if both is None else both[i] for both in further),
        )
        for i in (0, 1)
    )
    return first, rest


def join(whole: Moment, first: Moment, rest: Moment, after: Moment) -> Moment:
    """Return ``whole``, which has been split, with its first rows as they are ``after`` a layer.

    Where the layer has added axes, the other rows get those of their rotations and scales.

    Raises:
        ValueError: the layer has added features, which splats that stand still would lack.
    """
    if after.axes is not None and rest.axes is None:
        own = scaled_axes(rest.splats.quats, rest.splats.log_scales)
        rest = replace(rest, axes=own)
    changed = {
        name: torch.cat([tensor, getattr(rest.splats, name)])
        for name, tensor in after.splats.tensors().items()
        if tensor is not getattr(first.splats, name)  # what is left alone needs no copy
    }
    further: dict[str, Tensor | None] = {}
    for name in ("axes", "features"):
        now, still = getattr(after, name), getattr(rest, name)
        if (now is None) != (still is None):
            raise ValueError(f"a layer that adds {name} has to concern still splats as well")
        further[name] = None if now is None else torch.cat([now, still])
    return replace(whole, splats=replace(whole.splats, **changed), **further)


def mask_gradients(before: Moment, after: Moment, mask: Tensor) -> Moment:
    """Return ``after``, whose gradients go through the layers in the rows of the mask only."""
    masked = {
        name: _Masked.apply(tensor, getattr(after.splats, name), mask)
        for name, tensor in before.splats.tensors().items()
        if getattr(after.splats, name) is not tensor
    }
    further = (
        None if t is None else _Masked.apply(t.detach(), t, mask)
        for t in (after.axes, after.features)
    )
    return Moment(replace(after.splats, **masked), *further)


class _Masked(Function):
    @staticmethod
    def forward(ctx: Any, before: Tensor, after: Tensor, mask: Tensor) -> Tensor:
        ctx.mask = mask.view(-1, *[1] * (after.dim() - 1))
        return after.view_as(after)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_after: Tensor) -> tuple[Tensor, Tensor, None]:
        through = d_after * ctx.mask
        return d_after - through, through, None
