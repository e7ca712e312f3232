"""What an engine draws: one picture with what density control and evaluation need beside it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class Frame:
    """One drawn picture of H x W pixels of N splats.

    Attributes:
        rgb: (H, W, 3) colour over the background, linear in the splats' colours, unclamped.
        alpha: (H, W) accumulated opacity in [0, 1].
        depth: (H, W) blended camera z, sum of weight times z [world units], or None if not asked
            for; divide by alpha for the expected depth.
        radii: (N,) half extent of each splat on the screen [px]; 0 where it was not drawn.
        means2d: (N, 2) screen position of each splat [px]; its gradient drives density control.
        features: (H, W, F) blended features of the moment, sum of weight times feature, or None if
            it has none.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    radii: Tensor
    means2d: Tensor
    features: Tensor | None = None
