"""Shared memory with a place for every tensor of a model, whatever its number of splats."""

from __future__ import annotations

import math
import mmap
from collections.abc import Iterable, Mapping, Sequence

import torch
from torch import Tensor

from gsdmsr_cli.model.model import Model
from gsdmsr_cli.model.parameter import Parameter

_ALIGNED = 64
"""Places begin at multiples of a cache line [bytes]."""


class SharedBuffers:
    """Anonymous memory that forked processes share: it goes with the last one that holds it.

    It takes only what is written to.

    Args:
        parameters: what there is to be a place for.
        capacity: most splats that there will be.
        further: named float32 tensors beside them, with so many values per splat.
    """

    def __init__(
        self,
        parameters: Iterable[Parameter],
        capacity: int,
        further: Mapping[str, int] | None = None,
    ) -> None:
        self._places: dict[str, tuple[int, int, torch.dtype]] = {}
        total = 0
        for name, dtype, count in [
            *((p.name, p.tensor.dtype, _most_values(p, capacity)) for p in parameters),
            *((name, torch.float32, width * capacity) for name, width in (further or {}).items()),
        ]:
            self._places[name] = total, count, dtype
            total += -(-count * dtype.itemsize // _ALIGNED) * _ALIGNED
        memory = mmap.mmap(-1, max(total, _ALIGNED))
        self._memory = torch.frombuffer(memory, dtype=torch.uint8)

    def tensor(self, name: str, shape: Sequence[int]) -> Tensor:
        """Return the place of the named tensor.

        Raises:
            ValueError: there is no room for this shape.
        """
        start, most, dtype = self._places[name]
        count = math.prod(shape)
        if count > most:
            raise ValueError(f"{name} of shape {tuple(shape)} has room for {most} values")
        return self._memory[start : start + count * dtype.itemsize].view(dtype).view(tuple(shape))

    def publish(self, model: Model) -> None:
        """Move the model's tensors here, if they are elsewhere."""
        for parameter in model.parameters():
            place = self.tensor(parameter.name, parameter.tensor.shape)
            if parameter.tensor.data_ptr() != place.data_ptr():
                place.copy_(parameter.tensor.detach())
                parameter.tensor.data = place

    def attach(self, model: Model, shapes: Iterable[Sequence[int]]) -> None:
        """Let the model's tensors be those that lie here, of these shapes."""
        for parameter, shape in zip(model.parameters(), shapes, strict=True):
            parameter.tensor.data = self.tensor(parameter.name, shape)

    @torch.no_grad()
    def write(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy the tensors to their places."""
        for name, tensor in tensors.items():
            self.tensor(name, tensor.shape).copy_(tensor)


def _most_values(parameter: Parameter, capacity: int) -> int:
    rows = 1 if parameter.per_splat else parameter.rows_per_splat
    if not rows:
        return parameter.tensor.numel()
    return math.prod(parameter.tensor.shape[1:]) * capacity * rows
