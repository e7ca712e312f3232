"""What motions share that read grids: their tensors as parameters, their times, their rows."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from gsdmsr_cli.model.parameter import Parameter, Rate
from gsdmsr_cli.ops.network import Layer
from gsdmsr_cli.ops.planes import Level


def name_parameters(name: str, parts: Sequence[Level | Layer], rate: Rate) -> list[Parameter]:
    """Return a grid's levels or a network's layers as parameters "name.0.space" and so on."""
    return [
        Parameter(f"{name}.{index}.{field}", tensor, rate=rate)
        for index, part in enumerate(parts)
        for field, tensor in part._asdict().items()
    ]


def split_times(rows: Tensor, count: int) -> Sequence[Tensor]:
    """Return the rows (N, K) of each of ``count`` times, which ``rows`` (count N, K) holds."""
    return [rows] if count == 1 else rows.unflatten(0, (count, len(rows) // count)).unbind()


def time_nodes(frames: int, cells_per_frame: float, least: int = 8) -> int:
    """Return the nodes of a time grid for so many distinct times, ``least`` or more."""
    return max(round(frames * cells_per_frame), least)
