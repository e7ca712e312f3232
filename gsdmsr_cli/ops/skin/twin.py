"""Splats that follow control points, in plain torch."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product, quat_to_rotmat
from gsdmsr_cli.ops.displace.twin import PARTS
from gsdmsr_cli.ops.skin.cpu import SHORTEST

COLUMNS = [9, 3, 4, 3]
"""Columns of a transform: matrix, offset, quaternion, log scales; see ``ops.skin.cpu``."""


def transforms_twin(points: Tensor, deformation: Tensor) -> Tensor:
    """Return what ``transforms`` does, in plain torch, for any device and dtype."""
    offset, turn, growth = deformation.split(PARTS, dim=1)
    nothing = torch.zeros_like(turn)
    nothing[:, 0] = 1
    quats = torch.nn.functional.normalize(nothing + turn, dim=1, eps=SHORTEST)
    matrix = quat_to_rotmat(quats) - torch.eye(3, dtype=turn.dtype, device=turn.device)
    shift = offset - (matrix @ points[:, :, None])[:, :, 0]
    return torch.cat([matrix.flatten(1), shift, quats - nothing, growth], dim=1)


def skin_twin(
    splats: Splats, points: Tensor, log_radii: Tensor, transforms: Tensor, near: Tensor
) -> Splats:
    """Return what ``skin`` does, in plain torch, for any device and dtype.

    Values that are not finite count as 0 in products: else a splat that passes no gradient would
    pass NaN to the points, which are shared. What it goes to is not finite all the same.
    """
    rows = near.long()
    means, quats = (torch.where(t.isfinite(), t, 0.0) for t in (splats.means, splats.quats))
    squares = (means[:, None] - points[rows]).square().sum(dim=2)
    weights = torch.softmax(-0.5 * squares * torch.exp(-2 * log_radii)[rows], dim=1)
    blend = (weights[:, :, None] * transforms[rows]).sum(dim=1)
    matrix, shift, turn, growth = blend.split(COLUMNS, dim=1)
    moved = (matrix.unflatten(1, (3, 3)) @ means[:, :, None])[:, :, 0] + shift
    return replace(
        splats,
        means=splats.means + moved,
        quats=splats.quats + quat_product(turn, quats),
        log_scales=splats.log_scales + growth,
    )
