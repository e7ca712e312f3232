"""Rotations and scales in one way of the many that say the same."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.geometry import nearest_quats, quat_product, quat_to_rotmat

LEAST = 1e-12
"""Standard deviations count as this much at least [world units]."""


def upright(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit quaternions (N, 4) whose w is the largest, of splats that look the same.

    Half turns about a splat's own axes change nothing of it. The second result are the
    quaternions (N, 4) by which the given ones were multiplied from the right, up to their length.
    """
    unit = torch.nn.functional.normalize(quats, dim=1)
    largest = unit.abs().argmax(dim=1)
    turns = torch.zeros_like(unit)
    sign = torch.where(unit.gather(1, largest[:, None])[:, 0] < 0, -1.0, 1.0).to(unit)
    turns[torch.arange(len(unit)), largest] = torch.where(largest == 0, sign, -sign)
    return quat_product(unit, turns), turns


def rotations_and_scales(moment: Moment, first: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return unit quaternions (N, 4) and log scales (N, 3) of a moment, whatever it says them by.

    Args:
        moment: N splats.
        first: (N, 4) quaternions at an earlier time; axes are matched to those, and signs.
    """
    if moment.axes is None:
        quats = torch.nn.functional.normalize(moment.splats.quats, dim=1)
        log_scales = moment.splats.log_scales
    else:
        frames, scales, _ = torch.linalg.svd(moment.axes.double())
        if first is not None:
            frames, scales = _matched(frames, scales, quat_to_rotmat(first.double()))
        frames = frames * torch.linalg.det(frames).sign()[:, None, None]
        quats = nearest_quats(frames).to(moment.splats.means)
        log_scales = scales.clamp(min=LEAST).log().to(quats)
    if first is not None:
        quats = torch.where((quats * first).sum(dim=1, keepdim=True) < 0, -quats, quats)
    return quats, log_scales


def _matched(frames: Tensor, scales: Tensor, to: Tensor) -> tuple[Tensor, Tensor]:
    """Return axes (N, 3, 3), columns, and scales (N, 3), ordered and signed as in ``to``."""
    likeness = to.mT @ frames
    orders = torch.tensor(list(itertools.permutations(range(3))))
    scores = torch.stack([likeness[:, range(3), order].square().sum(dim=1) for order in orders])
    best = orders[scores.argmax(dim=0)]
    frames = frames.gather(2, best[:, None].expand_as(frames))
    signs = (to * frames).sum(dim=1).sign()
    return frames * torch.where(signs == 0, 1.0, signs)[:, None], scales.gather(1, best)
