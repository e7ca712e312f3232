"""Adaptive density control: clone, split, prune and opacity reset (3DGS, section 5)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from gsdmsr_cli.geometry import quat_to_rotmat
from gsdmsr_cli.preset import DensityOptions
from gsdmsr_cli.splats import Splats

SPLIT_SHRINK = 1.6
"""A split splat's children are this much smaller (3DGS: 0.8 times the two children)."""

RESET_OPACITY = 0.01


class DensityStatistics:
    """Per splat, the mean length of the screen-space gradient over the views that drew it.

    The gradient is in normalised device coordinates, so that thresholds do not depend on the
    resolution: the pixel gradient times half the width and half the height.

    Attributes:
        total: (N,) sum of the lengths.
        views: (N,) number of views that drew the splat.
    """

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.total = torch.zeros(count, device=device)
        self.views = torch.zeros(count, device=device)

    @torch.no_grad()
    def observe(self, gradient: Tensor, width: int, height: int) -> None:
        """Add one drawn view.

        Splats that move no pixel, behind opaque ones for instance, do not count as drawn, nor do
        those whose gradient is not finite.

        Args:
            gradient: (N, 2) of the view's own loss, by the positions on the screen [1 / px].
            width, height: of the view's picture [px].
        """
        x, y = gradient.unbind(1)
        scaled = torch.stack([x * (0.5 * width), y * (0.5 * height)], dim=1)
        length = scaled.norm(dim=1).nan_to_num(0.0, 0.0)
        self.total += length
        self.views += length > 0

    def mean(self) -> Tensor:
        """Return the (N,) means; 0 where a splat was never drawn."""
        return self.total / self.views.clamp(min=1)

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by name."""
        return {"total": self.total, "views": self.views}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""
        self.total, self.views = tensors["total"], tensors["views"]


@torch.no_grad()
def grow_and_prune(
    splats: Splats,
    statistics: DensityStatistics,
    options: DensityOptions,
    radius: float,
    growing: bool,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor, Splats]:
    """Decide which splats go on, and which are cloned and split.

    Args:
        splats: N canonical splats.
        statistics: their gradients since the last call.
        options: thresholds.
        radius: the scene's radius [world units].
        growing: whether splats may be cloned and split, or only pruned.
        generator: source of the split children's positions.

    Returns:
        rows (M,), the parent of each new row; fresh (M,) bool, whether the row is a clone or a
        child; and the M new splats, with the children moved and shrunk.
    """
    largest = splats.log_scales.exp().amax(dim=1)
    kept = torch.sigmoid(splats.logit_opacities) >= options.prune_opacity
    kept &= largest <= options.prune_scale * radius
    for tensor in splats.tensors().values():
        kept &= tensor.isfinite().reshape(len(splats), -1).all(dim=1)
    wanted = _chosen(statistics, options, int(kept.sum())) if growing else torch.zeros_like(kept)
    grows = kept & wanted
    split = grows & (largest > options.split_scale * radius)
    survivors, clones = kept & ~split, grows & ~split
    children = split.nonzero().flatten().repeat(2)
    rows = torch.cat([survivors.nonzero().flatten(), clones.nonzero().flatten(), children])
    fresh = torch.arange(len(rows), device=rows.device) >= int(survivors.sum())
    grown = splats.detach().take(rows)
    if len(children):
        _scatter_children(grown, len(children), generator)
    return rows, fresh, grown


def _chosen(statistics: DensityStatistics, options: DensityOptions, kept: int) -> Tensor:
    """Return which splats have a large gradient, the largest first if the cap leaves few places."""
    mean = statistics.mean()
    chosen = mean >= options.gradient
    room = max(options.cap - kept, 0)
    if int(chosen.sum()) > room:
        best = mean.argsort(descending=True, stable=True)[:room]
        chosen = torch.zeros_like(chosen)
        chosen[best] = True
    return chosen


def _scatter_children(grown: Splats, count: int, generator: torch.Generator) -> None:
    """Draw the last ``count`` means from their parents' Gaussians and shrink them, in place."""
    children = slice(len(grown) - count, None)
    scales = grown.log_scales[children].exp()
    noise = torch.randn(count, 3, generator=generator).to(scales) * scales
    turned = quat_to_rotmat(grown.quats[children]) @ noise[:, :, None]
    grown.means[children] += turned[:, :, 0]
    grown.log_scales[children] -= math.log(SPLIT_SHRINK)


@torch.no_grad()
def reset_opacities(splats: Splats) -> None:
    """Lower every opacity to 0.01 at most, in place, so that useless splats can be told apart."""
    splats.logit_opacities.clamp_(max=math.log(RESET_OPACITY / (1 - RESET_OPACITY)))
