"""Adam over named tensors, with a step multiplier per row and a true skip of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.kernels import adam as kernels
from gsdmsr_cli.tensors import array, has_kernels

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


class Move(NamedTuple):
    """What one step does to one tensor.

    Attributes:
        tensor, gradient, first, second: contiguous, of one shape; the gradient is only read.
        step: the number of the step, from 1.
        rate: learning rate.
    """

    tensor: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: int
    rate: float


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
        by_kernel: list[Move] = []
        by_twin: list[Move] = []
        for name, tensor in tensors.items():
            if tensor.grad is None:
                continue
            if name not in self.first:
                self.first[name], self.second[name] = (torch.zeros_like(tensor) for _ in "12")
                self.steps[name] = 0
            self.steps[name] += 1
            moments = self.first[name], self.second[name]
            gradient = tensor.grad.contiguous()
            moves = by_kernel if has_kernels(tensor) else by_twin
            moves.append(Move(tensor, gradient, *moments, self.steps[name], rates[name]))
            tensor.grad = None
        adam_steps(by_kernel, multipliers)
        adam_steps_twin(by_twin, multipliers)

    def take(self, names: Sequence[str], rows: Tensor, fresh: Tensor) -> None:
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


def adam_steps(moves: Sequence[Move], multipliers: Tensor | None) -> None:
    """Make all the moves in place, by one kernel."""
    if not moves:
        return
    table, steps = np.empty((len(moves), 6), np.int64), np.empty((len(moves), 2), np.float32)
    for i, (tensor, gradient, first, second, step, rate) in enumerate(moves):
        size = tensor.numel()
        width = 0 if multipliers is None else size // len(tensor)
        addresses = (t.data_ptr() for t in (tensor, gradient, first, second))
        table[i] = *addresses, size, width
        steps[i] = rate / (1 - BETA1**step), 1 / (1 - BETA2**step)
    factors = np.empty(0, np.float32) if multipliers is None else array(multipliers)
    kernels.adam(table, steps, factors, *map(np.float32, (BETA1, BETA2, EPS)))


def adam_steps_twin(moves: Sequence[Move], multipliers: Tensor | None) -> None:
    """Make all the moves in place, in plain torch, on any device and dtype."""
    for tensor, gradient, first, second, step, rate in moves:
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
