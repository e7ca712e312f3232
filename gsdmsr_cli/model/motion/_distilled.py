"""Distils a motion into rigid groups, and what these leave into series that all splats share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.motion import _grouping as grouping
from gsdmsr_cli.model.motion._shared_series import fit_series

MOMENTS = 8
"""Times, evenly spaced, at which trajectories are compared."""

OWN = 6
"""Columns of what a splat does of its own: of its place in its group's frame, of its log scales."""

At = Callable[[float], Splats]
"""Where N splats are at a time, by the motion that is distilled."""


class Groups(NamedTuple):
    """N splats in J groups that move as rigid bodies.

    Attributes:
        splats: the canonical ones, near those of half time.
        anchors: (J, 3) places that groups turn about.
        group: (N,) int64, below J.
        keys: (T, J, 10) movements at evenly spaced times, see ``ops.skin.transforms``.
    """

    splats: Splats
    anchors: Tensor
    group: Tensor
    keys: Tensor


def learn_groups(at: At, among: Tensor, count: int, times: int) -> Groups:
    """Return so many groups, with keyframes at so many times, as the motion goes in the mean.

    Args:
        at: the motion.
        among: rows of the splats that may be anchors.
        count: J; there are no more than splats.
        times: T.
    """
    before, then = at(0.5), [at(i / (MOMENTS - 1)) for i in range(MOMENTS)]
    chosen = grouping.spread_rows(then[0].means, among, min(count, len(before)))
    anchors, kept = before.means[chosen], min(grouping.NEAREST, len(chosen))
    near = grouping.group_paths(torch.stack([one.means for one in then]), chosen, kept)
    shown = before.logit_opacities.sigmoid(), anchors
    group = grouping.group_splats(before, then, near, *shown)
    splats = grouping.settle(before, then, group, *shown)
    moments = (at(i / (times - 1)) for i in range(times))
    keys = torch.stack([grouping.fit_movements(splats, one, group, *shown) for one in moments])
    return Groups(splats, anchors, group, grouping.align(keys, (times - 1) // 2))


def learn_series(at: At, groups: Groups, count: int) -> tuple[Splats, Tensor, Tensor]:
    """Return canonical splats, series (T, K) and shares (N, K, 6) of what groups leave of a motion.

    Places count in units of the splat's size, and so on equal terms with log scales.

    Args:
        at: the motion.
        groups: what has been learnt of it.
        count: K.
    """
    splats, _, _, keys = groups
    size = splats.log_scales.exp().mean(dim=1, keepdim=True).expand(-1, 3)
    units = torch.cat([size, torch.ones_like(size)], dim=1)

    def left(time: int) -> Tensor:
        after = at(time / (len(keys) - 1))
        places = grouping.take_back(after.means, keys[time], groups.group, groups.anchors)
        off = places - splats.means, after.log_scales - splats.log_scales
        return torch.cat(off, dim=1) / units

    means, series, shares = fit_series(left, len(keys), count)
    return add_own(splats, means * units), series, shares * units[:, None]


def add_own(splats: Splats, offsets: Tensor) -> Splats:
    """Return splats with offsets (N, 6) of their means and log scales."""
    shift, growth = offsets.split(OWN // 2, dim=1)
    return replace(splats, means=splats.means + shift, log_scales=splats.log_scales + growth)
