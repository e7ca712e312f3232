"""Colours of splats that have turned, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.ops.series.twin import add_series_twin


@torch.no_grad()
def turns_twin(quats: Tensor, canonical_quats: Tensor) -> Tensor:
    """Return twice the vector parts (N, 3) of the unit quaternions between rotations (N, 4)."""
    back = torch.cat([canonical_quats[:, :1], -canonical_quats[:, 1:]], dim=1)
    turns = torch.nn.functional.normalize(quat_product(quats, back), dim=1)
    return torch.where(turns[:, :1] < 0, -2.0, 2.0) * turns[:, 1:]


def light_twin(sh: Tensor, slopes: Tensor, quats: Tensor, canonical_quats: Tensor) -> Tensor:
    """Return what ``light`` does, for any device and dtype."""
    turns = turns_twin(quats, canonical_quats)
    return add_series_twin(sh.flatten(1), slopes, turns).view_as(sh)
