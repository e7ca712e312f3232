"""One tensor of a model: its name, its rows, and the learning rate that it follows."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import torch
from torch import Tensor

Rate = str | tuple[float, float]
"""A learning rate: the name of one of the preset's (a field of ``OptimizerOptions``), or its own
values at the start and at the end of a training, log-linear in between."""

NO_TIMES: Mapping[str, int] = MappingProxyType({})

Place = Callable[[float], float]
"""Where a time in [0, 1] lies between the first and the last entry of a time axis, in [0, 1]."""


def evenly(time: float) -> float:
    """Return where a time lies on an axis whose entries belong to times that are evenly spaced."""
    return time


@dataclass(frozen=True, eq=False)
class Parameter:
    """One tensor of a model, trained or not.

    The optimiser, averaging, shared memory, checkpoints, saliency and resizing all read lists of
    these and nothing else.

    Attributes:
        name: under which it is saved, unique in its list.
        tensor: its values, contiguous; the same object for good, whose memory a resize replaces.
        per_splat: whether it has a row for each splat; if not, all splats share it.
        rate: the learning rate that it follows; None for a buffer, of any dtype, that is saved but
            not trained.
        fill: value of a row that is new: of a splat that has stood still and begins to move.
        time_axis: the dimension whose entries belong to times from 0 to 1, if there is one.
        time_place: where times lie on it; it rises from 0 to 1.
        time_degree: of the B-splines whose coefficients its entries are, an odd number; 1 are the
            straight lines between them.
        rows_per_splat: how many rows it has at most for each splat, where it is shared and its rows
            are counted in training; 0 where they are counted at the start.
    """

    name: str
    tensor: Tensor
    per_splat: bool = False
    rate: Rate | None = None
    fill: float = 0.0
    time_axis: int | None = None
    time_place: Place = evenly
    time_degree: int = 1
    rows_per_splat: int = 0

    def __post_init__(self) -> None:
        self.tensor.requires_grad_(self.rate is not None)

    def set_values(self, values: Tensor) -> None:
        """Give the tensor other values, of any shape and on any device."""
        self.tensor.data = values.detach().contiguous()
        self.tensor.grad = None

    def take(self, rows: Tensor) -> None:
        """Make row i what row ``rows[i]`` was, (M,) int64; a new one where there was none such."""
        self.set_values(take_rows(self.tensor.detach(), rows, self.fill))

    def hold_outside(self, first: float, last: float) -> None:
        """Give times outside of [first, last] the values of the nearest that count within it.

        Without a time axis nothing changes.
        """
        if self.time_axis is None:
            return
        values = self.tensor.detach().movedim(self.time_axis, 0)
        end, further = len(values) - 1, self.time_degree // 2
        lower = max(math.floor(self.time_place(first) * end) - further, 0)
        upper = min(math.ceil(self.time_place(last) * end) + further, end)
        values[:lower] = values[lower].clone()
        values[upper + 1 :] = values[upper].clone()


def take_rows(tensor: Tensor, rows: Tensor, fill: float) -> Tensor:
    """Return rows (M,) int64 of a tensor (N, ...), filled with a value where they are N or more."""
    if not (rows >= len(tensor)).any():
        return tensor[rows]
    beyond = tensor.new_full((1, *tensor.shape[1:]), fill)
    return torch.cat([tensor, beyond])[rows.clamp(max=len(tensor))]


def tensors_of(parameters: Iterable[Parameter]) -> dict[str, Tensor]:
    """Return the tensors by name, in the order of the list."""
    return {parameter.name: parameter.tensor for parameter in parameters}


def below(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin with the prefix, without it."""
    return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}


class Part(Protocol):
    """A level of a grid or a layer of a network: a named tuple of tensors."""

    def _asdict(self) -> Mapping[str, Tensor]: ...


def name_parameters(
    name: str,
    parts: Sequence[Part],
    rate: Rate,
    time_axes: Mapping[str, int] = NO_TIMES,
    time_place: Place = evenly,
    time_degree: int = 1,
) -> list[Parameter]:
    """Return a grid's levels or a network's layers as parameters "name.0.space" and so on.

    Args:
        name: of all of them.
        parts: the levels or layers.
        rate: the learning rate that all follow.
        time_axes: dimensions that run over times, by the names of the parts' fields.
        time_place: where times lie on those.
        time_degree: of the B-splines along them.
    """
    return [
        Parameter(
            f"{name}.{index}.{field}",
            tensor,
            rate=rate,
            time_axis=time_axes.get(field),
            time_place=time_place,
            time_degree=time_degree,
        )
        for index, part in enumerate(parts)
        for field, tensor in part._asdict().items()
    ]
