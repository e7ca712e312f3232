"""One tensor of a model: its name, its rows, and the learning rate that it follows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

Rate = str | tuple[float, float]
"""A learning rate: the name of one of the preset's (a field of ``OptimizerOptions``), or its own
values at the start and at the end of a training, log-linear in between."""


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
    """

    name: str
    tensor: Tensor
    per_splat: bool = False
    rate: Rate | None = None
    fill: float = 0.0

    def __post_init__(self) -> None:
        self.tensor.requires_grad_(self.rate is not None)

    def set_values(self, values: Tensor) -> None:
        """Give the tensor other values, of any shape and on any device."""
        self.tensor.data = values.detach().contiguous()
        self.tensor.grad = None

    def take(self, rows: Tensor) -> None:
        """Make row i what row ``rows[i]`` was, (M,) int64; a new one where there was none such."""
        self.set_values(take_rows(self.tensor.detach(), rows, self.fill))


def take_rows(tensor: Tensor, rows: Tensor, fill: float) -> Tensor:
    """Return rows (M,) int64 of a tensor (N, ...), filled with a value where they are N or more."""
    if not (rows >= len(tensor)).any():
        return tensor[rows]
    beyond = tensor.new_full((1, *tensor.shape[1:]), fill)
    return torch.cat([tensor, beyond])[rows.clamp(max=len(tensor))]


def tensors_of(parameters: Iterable[Parameter]) -> dict[str, Tensor]:
    """Return the tensors by name, in the order of the list."""
    return {parameter.name: parameter.tensor for parameter in parameters}


class Part(Protocol):
    """A level of a grid or a layer of a network: a named tuple of tensors."""

    def _asdict(self) -> Mapping[str, Tensor]: ...


def name_parameters(name: str, parts: Sequence[Part], rate: Rate) -> list[Parameter]:
    """Return a grid's levels or a network's layers as parameters "name.0.space" and so on."""
    return [
        Parameter(f"{name}.{index}.{field}", tensor, rate=rate)
        for index, part in enumerate(parts)
        for field, tensor in part._asdict().items()
    ]
