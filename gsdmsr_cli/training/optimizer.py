"""Adam over named tensors, with a step multiplier per row and a true skip of rows."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.kernels import adam as kernels
from gsdmsr_cli.tensors import array, has_kernels

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


class Adam:
    """First and second moments of every tensor that has had a gradient (Kingma & Ba 2015).

    Attributes:
        first, second: moments by the tensor's name.
        steps: how many steps each tensor has made.
    """

    def __init__(self) -> None:
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}
        self.steps: dict[str, int] = {}

    @torch.no_grad()
    def step(
        self,
        tensors: Mapping[str, Tensor],
        rates: Mapping[str, float],
        multipliers: Tensor | None = None,
    ) -> None:
        """Move every tensor that has a gradient, and clear the gradient.

        Args:
            tensors: the tensors to move, by name.
            rates: the learning rate of each of them.
            multipliers: (N,) factor on the step of each row, for tensors of N rows; a row with
                factor 0 keeps its values and moments untouched.
        """
        for name, tensor in tensors.items():
            if tensor.grad is None:
                continue
            if name not in self.first:
                self.first[name], self.second[name] = (torch.zeros_like(tensor) for _ in "12")
                self.steps[name] = 0
            self.steps[name] += 1
            move = adam_step if has_kernels(tensor) else adam_step_twin
            moments = self.first[name], self.second[name]
            gradient = tensor.grad.contiguous()
            move(tensor, gradient, *moments, self.steps[name], rates[name], multipliers)
            tensor.grad = None

    def take(self, names: list[str], rows: Tensor, fresh: Tensor) -> None:
        """Follow a resize of the named tensors; rows that are ``fresh`` (M,) start without moments.

        The step count is shared by all rows and goes on.
        """
        for name in names:
            for moments in (self.first, self.second):
                if name in moments:
                    taken = moments[name][rows]
                    taken[fresh] = 0
                    moments[name] = taken

    def forget(self, name: str, second: bool = True) -> None:
        """Set the tensor's first moment to zero, and its second unless told otherwise."""
        for moments in (self.first, self.second) if second else (self.first,):
            if name in moments:
                moments[name].zero_()


def adam_step(
    tensor: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    step: int,
    rate: float,
    multipliers: Tensor | None,
) -> None:
    """Make the ``step``-th step in place, by kernel."""
    numbers = (rate, BETA1, BETA2, EPS, 1 - BETA1**step, 1 - BETA2**step)
    scalars = tuple(np.float32(x) for x in numbers)
    arrays = [array(t) for t in (tensor, gradient, first, second)]
    if multipliers is None:
        kernels.adam(*(a.reshape(-1) for a in arrays), *scalars)
    else:
        rows = (a.reshape(len(tensor), -1) for a in arrays)
        kernels.adam_rows(*rows, array(multipliers), *scalars)


def adam_step_twin(
    tensor: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    step: int,
    rate: float,
    multipliers: Tensor | None,
) -> None:
    """Make the ``step``-th step in place, in plain torch, on any device and dtype."""
    m = first * BETA1 + gradient * (1 - BETA1)
    v = second * BETA2 + gradient.square() * (1 - BETA2)
    move = rate / (1 - BETA1**step) * m / ((v / (1 - BETA2**step)).sqrt() + EPS)
    if multipliers is not None:
        factor = multipliers.to(tensor.dtype).reshape(-1, *[1] * (tensor.dim() - 1))
        moved = factor != 0
        move = torch.where(moved, factor * move, 0.0)
        m, v = torch.where(moved, m, first), torch.where(moved, v, second)
    tensor -= move
    first.copy_(m)
    second.copy_(v)
