"""Adding a deformation to splats in plain torch."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.displace.cpu import MEAN, QUAT, SCALE

PARTS = [MEAN, QUAT, SCALE]
"""Columns of a deformation: offsets of the mean (3), the quaternion (4) and the log scales (3)."""

OUTPUTS = sum(PARTS)


def displace_twin(splats: Splats, deformation: Tensor, shift: Tensor | None = None) -> Splats:
    """Return what ``displace`` does, in plain torch, for any device and dtype."""
    offset, turn, growth = deformation.split(PARTS, dim=1)
    return replace(
        splats,
        means=splats.means + offset + (0 if shift is None else shift),
        quats=splats.quats + turn,
        log_scales=splats.log_scales + growth,
    )
