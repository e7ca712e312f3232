"""From a field's output to moved splats, and what field-based motions share."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.fields.network import Layer
from gsdmsr_cli.fields.planes import Level
from gsdmsr_cli.splats import Splats

OUTPUTS = 10
"""Columns of a deformation: offsets of the mean (3), the quaternion (4) and the log scales (3)."""


def displace(splats: Splats, deformation: Tensor) -> Splats:
    """Add a deformation (N, 10) to the stored values, before activation (4D-GS, equation 7)."""
    shift, turn, stretch = deformation.split((3, 4, 3), dim=1)
    return Splats(
        means=splats.means + shift,
        quats=splats.quats + turn,
        log_scales=splats.log_scales + stretch,
        logit_opacities=splats.logit_opacities,
        sh=splats.sh,
    )


def time_nodes(frames: int, cells_per_frame: float, least: int = 8) -> int:
    """Return the nodes of a time grid for so many distinct times, ``least`` or more."""
    return max(round(frames * cells_per_frame), least)


def name_tensors(
    levels: dict[str, list[Level]], layers: dict[str, list[Layer]]
) -> dict[str, Tensor]:
    """Return all tensors of grids and networks as "grid.0.space", "network.1.weight" and so on."""
    named: dict[str, Tensor] = {}
    for kind in (levels, layers):
        for name, parts in kind.items():
            for index, part in enumerate(parts):
                for field, tensor in part._asdict().items():
                    named[f"{name}.{index}.{field}"] = tensor
    return named


def trained(part: Level | Layer) -> Level | Layer:
    """Return the level or layer with tensors that collect gradients."""
    return type(part)(*(torch.nn.Parameter(tensor) for tensor in part))  # type: ignore[arg-type]
