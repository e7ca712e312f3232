"""Gradients of splats on the screen, summed up for density control."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor


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

    @torch.no_grad()
    def observe_views(self, gradients: Tensor, width: int, height: int) -> None:
        """Do what ``observe`` does of V views of one size, by the launches of one on a GPU.

        Args:
            gradients: (V, N, 2), of each view.
            width, height: of their pictures [px].
        """
        x, y = gradients.unbind(2)
        lengths = torch.hypot(x * (0.5 * width), y * (0.5 * height)).nan_to_num(0.0, 0.0)
        self.total += lengths.sum(dim=0)
        self.views += (lengths > 0).sum(dim=0)

    def mean(self) -> Tensor:
        """Return the (N,) means; 0 where a splat was never drawn."""
        return self.total / self.views.clamp(min=1)

    def take(self, rows: Tensor) -> None:
        """Follow a resize: row i becomes what row ``rows[i]`` was; rows is (M,) int64."""
        self.total, self.views = self.total[rows], self.views[rows]

    def clear(self) -> None:
        """Begin anew."""
        self.total.zero_()
        self.views.zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by name."""
        return {"total": self.total, "views": self.views}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""
        self.total, self.views = tensors["total"], tensors["views"]
