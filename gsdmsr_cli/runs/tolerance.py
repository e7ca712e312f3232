"""In how few bits a model's tensors may be stored for what is drawn to stay where it is, nearly.

A tensor's values are rounded, and the splats that are drawn at some moments compared with what they
were. So neither the data nor a rule for each kind of motion is needed.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Collection, Mapping

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.runs.packed_values import HALF, MOST_HALF, RAW, Form, rounded
from gsdmsr_cli.scene.camera import Camera

MOMENTS = 5
"""Times, evenly spaced, at which splats are compared."""

STEPS = tuple(Form("steps", bits) for bits in range(4, 17))
"""The steps that a tensor may be rounded to, the coarsest first."""

_TRIES = 12
"""How often the share of a tensor is halved, where all together are off by more than tolerated."""


@torch.no_grad()
def forms_of(model: Model, tolerance: float, names: Collection[str]) -> dict[str, Form]:
    """Return in which form each of the tensors is stored, by its name; the model stays as it is.

    Steps of as few bits as do, or halves, or float32 where neither does. What nothing shows of, as
    of what makes colours anew after drawing, has halves.

    Args:
        model: of N splats.
        tolerance: how far what is drawn may be off with all tensors rounded, see ``distance``.
        names: of the tensors, float32.
    """
    exact = [moment.map(torch.clone) for moment in _drawn(model)]
    share = tolerance / max(len(names), 1) ** 0.5  # as if they had nothing to do with one another
    for _ in range(_TRIES):
        found = {name: _form_of(model, name, exact, share) for name in names}
        if _off(model, found, exact) <= tolerance:
            return found
        share /= 2
    return dict.fromkeys(names, RAW)


def _form_of(model: Model, name: str, exact: list[Moment], tolerance: float) -> Form:
    """Return the form that keeps one tensor by itself to a tolerance."""
    values = model.tensors()[name]
    if not values.numel() or values.min() == values.max():
        return STEPS[0]  # exact
    half = HALF if float(values.abs().max()) <= MOST_HALF else RAW
    if _off(model, {name: STEPS[0]}, exact) == 0:
        return half
    place = bisect_left(STEPS, True, key=lambda form: _off(model, {name: form}, exact) <= tolerance)
    if place < len(STEPS):
        return STEPS[place]
    return half if _off(model, {name: half}, exact) <= tolerance else RAW


def _off(model: Model, forms: Mapping[str, Form], exact: list[Moment]) -> float:
    """Return the distance with tensors rounded to these forms, by their names."""
    tensors = {name: model.tensors()[name] for name in forms}
    before = {name: tensor.detach().clone() for name, tensor in tensors.items()}
    for name, tensor in tensors.items():
        tensor.copy_(torch.from_numpy(rounded(tensor.cpu().numpy(), forms[name])))
    try:
        return distance(exact, _drawn(model))
    finally:
        for name, tensor in tensors.items():
            tensor.copy_(before[name])
        _forget(model)


def _drawn(model: Model) -> list[Moment]:
    """Return the splats at each of the moments, by the values that tensors have now."""
    _forget(model)
    at = np.eye(4)
    at[:3, 3] = -model.splats.means.detach().double().mean(dim=0).cpu().numpy()
    camera = Camera(at, 1.0, 1.0, 0.5, 0.5, 1, 1)  # for layers that want one
    times = [i / (MOMENTS - 1) for i in range(MOMENTS)]
    return model.at_instants([model.instant(time, camera) for time in times])


def _forget(model: Model) -> None:
    """Let layers drop what they have found out of former values, as after any resize."""
    rows = torch.arange(len(model.splats), device=model.splats.means.device)
    for layer in model.layers.values():
        count = len(rows) if layer.concerns_still else model.moving
        layer.take(rows[:count], torch.zeros_like(rows[:count], dtype=torch.bool))


def distance(exact: list[Moment], found: list[Moment]) -> float:
    """Return how far splats are off, as the root of the mean square over splats and moments.

    Of a splat it is the root of the sum of squares of what its centre is off, in units of its own
    size and at most 1; its rotation, as an angle [rad]; its log scales; its opacity; its features;
    its colour, as the sum over harmonics. Splats count by their opacity and their size: what is
    large covers more pixels, but detail is in what is small.
    """
    parts = []
    for before, after in zip(exact, found, strict=True):
        size = _sizes(before)
        weights = size * before.splats.logit_opacities.sigmoid()
        shares = (weights / weights.sum().clamp(min=1e-30)).nan_to_num()
        parts.append((shares * _squares(before, after, size).nan_to_num()).sum())
    return float(torch.stack(parts).mean().sqrt())


def _sizes(moment: Moment) -> Tensor:
    """Return how large splats are (N,) [world units], by the mean of their axes."""
    if moment.axes is not None:
        lengths: Tensor = moment.axes.flatten(1).norm(dim=1)
        return lengths / 3**0.5
    return moment.splats.log_scales.mean(dim=1).exp()


def _squares(before: Moment, after: Moment, size: Tensor) -> Tensor:
    """Return the square of what each splat is off (N,)."""
    a, b = before.splats, after.splats
    total = ((a.means - b.means).square().sum(dim=1) / size.square()).clamp(max=1)
    total = total + (a.logit_opacities.sigmoid() - b.logit_opacities.sigmoid()).square()
    total = total + (SH_C0 * (a.sh - b.sh)).square().flatten(1).sum(dim=1)
    if before.features is not None and after.features is not None:
        total = total + (before.features - after.features).square().sum(dim=1)
    if before.axes is not None and after.axes is not None:
        apart = (before.axes - after.axes).square().flatten(1).sum(dim=1)
        return total + apart / size.square()
    unit = torch.nn.functional.normalize
    turned = 2 * (unit(a.quats, dim=1) - unit(b.quats, dim=1))
    total = total + turned.square().sum(dim=1)
    return total + (a.log_scales - b.log_scales).square().sum(dim=1)
