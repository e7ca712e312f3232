"""Groups splats by their trajectories, and finds the rigid movement of each group.

GroupFlow of SpeeDe3DGS (Tu et al., CVPR 2026, section 3.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import nearest_quats, quat_to_rotmat, scaled_axes
from gsdmsr_cli.ops.displace import PARTS
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.ops.spread import spread_out

NEAREST, ROUNDS = 8, 3
"""Among how many groups, the nearest, splats choose the one whose movement fits them best, and how
often: beyond the paper, for splats where two bodies touch."""

_CHUNK = 1024
"""Splats whose distances from all anchors are worked out at a time: the memory that takes."""


def spread_rows(places: Tensor, among: Tensor, count: int) -> Tensor:
    """Return ``count`` of the rows ``among`` (M,) whose places (N, 3) are far apart, (count,)."""
    chosen = spread_out(places[among], count).to(places)
    first = torch.zeros(count, 1, dtype=torch.int32, device=places.device)
    return among[nearest_points(chosen, places[among], first)[:, 0].long()]


def group_paths(paths: Tensor, anchors: Tensor, kept: int) -> Tensor:
    """Return the anchors (N, kept) that each splat moves most alike and nearest to, best first.

    By half the mean of their distance over time, plus half its standard deviation.

    Args:
        paths: (T, N, 3) where splats are at a few times.
        anchors: (J,) rows of those that are anchors.
        kept: at most J.
    """
    own = paths[:, anchors]
    found = []
    for some in paths.split(_CHUNK, dim=1):
        apart = torch.cdist(some, own)
        score = apart.mean(dim=0) + apart.std(dim=0, correction=0)
        found.append(score.topk(kept, dim=1, largest=False).indices)
    return torch.cat(found)


def group_splats(
    before: Splats, then: Sequence[Splats], near: Tensor, weights: Tensor, anchors: Tensor
) -> Tensor:
    """Return the group (N,) int64, of those ``near`` (N, K), whose movement fits each splat best.

    Splats begin with the first one; as they change places, movements change (Lloyd 1982).

    Args:
        before: N splats.
        then: they at a few times.
        near: groups that each may belong to.
        weights, anchors: see ``fit_movements``.
    """
    group = near[:, 0]
    for _ in range(ROUNDS):
        off = torch.zeros_like(near, dtype=before.means.dtype)
        for after in then:
            ways, turns, _ = fit_movements(before, after, group, weights, anchors).split(PARTS, 1)
            matrices = quat_to_rotmat(turns + _identity(turns))
            shifts = anchors + ways - (matrices @ anchors[:, :, None])[:, :, 0]
            for k, own in enumerate(near.unbind(1)):
                goes = (matrices[own] @ before.means[:, :, None])[:, :, 0] + shifts[own]
                off[:, k] += (goes - after.means).square().sum(dim=1)
        group = near.gather(1, off.argmin(dim=1, keepdim=True))[:, 0]
    return group


def fit_movements(
    before: Splats, after: Splats, group: Tensor, weights: Tensor, anchors: Tensor
) -> Tensor:
    """Return how each group moves as a rigid body, (J, 10): see ``ops.skin.transforms``.

    By least squares over its splats. These count as bodies rather than points, by the ends of
    their axes, so that a group of one turns as it does. Nothing grows. A group without
    splats stays where it is.

    Args:
        before, after: N splats.
        group: (N,) int64, below J.
        weights: (N,) of the splats, above 0.
        anchors: (J, 3) places before that groups turn about.
    """
    count = len(anchors)

    def mean(values: Tensor) -> Tensor:
        """Return the weighted means (J, C) of values (N, C) of each group."""
        total = values.new_zeros(count, values.shape[1] + 1)
        ones = torch.ones_like(weights)[:, None]
        total.index_add_(0, group, torch.cat([values, ones], dim=1) * weights[:, None])
        return total[:, :-1] / total[:, -1:].clamp(min=torch.finfo(total.dtype).tiny)

    middle, aim = mean(before.means), mean(after.means)
    arms = torch.stack([before.means - middle[group], after.means - aim[group]])
    axes, turned = (scaled_axes(one.quats, before.log_scales) for one in (before, after))
    outer = arms[1][:, :, None] * arms[0][:, None] + turned @ axes.mT
    quats = nearest_quats(mean(outer.flatten(1)).unflatten(1, (3, 3)))
    ways = (quat_to_rotmat(quats) @ (anchors - middle)[:, :, None])[:, :, 0] + aim - anchors
    return torch.cat([ways, quats - _identity(quats), torch.zeros_like(ways)], dim=1)


def settle(
    before: Splats, then: Sequence[Splats], group: Tensor, weights: Tensor, anchors: Tensor
) -> Splats:
    """Return splats, instead of ``before``, whose groups' movements fit a few times best.

    Each goes to the mean of where these movements take it from (generalised Procrustes analysis,
    Gower 1975): so what is not rigid is a little wrong at all times, rather than right at the time
    of ``before`` and the more wrong the further away from it. Sizes are the means of those times.
    Means of places far from the origin would round in float32, so it is done in float64.

    Args:
        before: N splats.
        then: they at the times.
        group, weights, anchors: see ``fit_movements``.
    """
    dtype = before.means.dtype
    before, *then = (one.map(Tensor.double) for one in (before, *then))
    weights, anchors = weights.double(), anchors.double()
    for _ in range(ROUNDS):
        total = torch.zeros_like(before.means)
        for after in then:
            movements = fit_movements(before, after, group, weights, anchors)
            total += take_back(after.means, movements, group, anchors)
        before = replace(before, means=total / len(then))
    scales = torch.stack([after.log_scales.exp() for after in then]).mean(dim=0)
    return replace(before, log_scales=scales.log()).map(lambda tensor: tensor.to(dtype))


def take_back(means: Tensor, movements: Tensor, group: Tensor, anchors: Tensor) -> Tensor:
    """Return the places (N, 3) that movements (J, 10) of their groups take to ``means``."""
    ways, turns, _ = movements.split(PARTS, 1)
    matrices = quat_to_rotmat(turns + _identity(turns))[group]
    arms = means - (anchors + ways)[group]
    places: Tensor = (matrices.mT @ arms[:, :, None])[:, :, 0] + anchors[group]
    return places


def align(keys: Tensor, start: int) -> Tensor:
    """Return keys (T, J, 10) whose quaternions go on smoothly from those of index ``start``.

    Of the two quaternions of each rotation the one nearer to that of the neighbouring time.
    """
    turns = keys[:, :, 3:7] + _identity(keys[0, :, 3:7])
    for order in (range(start, len(keys)), range(start, -1, -1)):
        last = _identity(turns[0])
        for time in order:
            same = (turns[time] * last).sum(dim=1, keepdim=True) >= 0
            last = turns[time] = torch.where(same, turns[time], -turns[time])
    return torch.cat([keys[:, :, :3], turns - _identity(turns[0]), keys[:, :, 7:]], dim=2)


def _identity(like: Tensor) -> Tensor:
    """Return (J, 4) quaternions (1, 0, 0, 0)."""
    return like.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(like), 4)
