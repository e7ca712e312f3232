"""Adam over named tensors, with a step multiplier per row and a true skip of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.cuda import adam as cuda
from gsdmsr_cli.cuda.launch import serves
from gsdmsr_cli.kernels import adam as kernels
from gsdmsr_cli.tensors import has_kernels
from gsdmsr_cli.training.state import below

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15

_FIRST, _SECOND = "first.", "second."


class Gate(NamedTuple):
    """What the rows of a tensor may do in a step.

    Attributes:
        multipliers: (N,) factor on the step of each row; a row with factor 0 keeps its values and
            moments untouched.
        trace: like the tensor, out: the step that each row would have made with factor 1.
    """

    multipliers: Tensor
    trace: Tensor


class Move(NamedTuple):
    """What one step does to one tensor.

    Attributes:
        tensor, gradient, first, second: contiguous, of one shape; the gradient is only read.
        step: the number of the step, from 1.
        rate: learning rate.
        gate: what its rows may do, if they are gated.
    """

    tensor: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: int
    rate: float
    gate: Gate | None = None


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
        gates: Mapping[str, Gate] | None = None,
        loss: Tensor | None = None,
    ) -> None:
        """Move every tensor that has a gradient, and clear the gradient.

        Args:
            tensors: the tensors to move, by name.
            rates: the learning rate of each of them.
            gates: what rows may do, of those tensors that are gated; a trace is left as it is
                where its tensor has no gradient.
            loss: () float32, where the gradients come from; on a GPU nothing is moved if it is not
                finite, so that nobody has to wait for it. Elsewhere the caller looks at it.
        """
        by_kernel: list[Move] = []
        by_cuda: list[Move] = []
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
            moves = by_cuda if serves(tensor) else by_kernel if has_kernels(tensor) else by_twin
            gate = (gates or {}).get(name)
            moves.append(Move(tensor, gradient, *moments, self.steps[name], rates[name], gate))
            tensor.grad = None
        adam_steps(by_kernel)
        adam_steps_cuda(by_cuda, loss)
        adam_steps_twin(by_twin)

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

    def calm(self, names: Sequence[str], rows: Tensor) -> None:
        """Take the momentum from the given rows of the named tensors."""
        for name in names:
            if name in self.first:
                self.first[name][rows] = 0

    def forget(self, name: str, second: bool = True) -> None:
        """Set the tensor's first moment to zero, and its second unless told otherwise."""
        for moments in (self.first, self.second) if second else (self.first,):
            if name in moments:
                moments[name].zero_()

    def tensors(self) -> dict[str, Tensor]:
        """Return the moments by name; the step counts are numbers, to be kept elsewhere."""
        first = {_FIRST + name: tensor for name, tensor in self.first.items()}
        return first | {_SECOND + name: tensor for name, tensor in self.second.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""
        self.first, self.second = below(_FIRST, tensors), below(_SECOND, tensors)


def adam_steps(moves: Sequence[Move]) -> None:
    """Make all the moves in place, by one kernel."""
    if not moves:
        return
    table, steps = np.empty((len(moves), 8), np.int64), np.empty((len(moves), 2), np.float32)
    for i, (tensor, gradient, first, second, step, rate, gate) in enumerate(moves):
        addresses = (t.data_ptr() for t in (tensor, gradient, first, second))
        gated = gate is not None and tensor.numel() > 0
        width = tensor.numel() // len(tensor) if gated else 0
        gates = (t.data_ptr() for t in gate) if gate is not None else (0, 0)
        table[i] = *addresses, tensor.numel(), width, *gates
        steps[i] = rate / (1 - BETA1**step), 1 / (1 - BETA2**step)
    kernels.adam(table, steps, *map(np.float32, (BETA1, BETA2, EPS)))


def adam_steps_cuda(moves: Sequence[Move], loss: Tensor | None = None) -> None:
    """Make all the moves in place, by one CUDA kernel, if the loss is finite."""
    rows = []
    for tensor, gradient, first, second, step, rate, gate in moves:
        factors = rate / (1 - BETA1**step), 1 / (1 - BETA2**step)
        gates = (None, None) if gate is None else tuple(gate)
        rows.append(cuda.Row(tensor, gradient, first, second, *factors, *gates))
    cuda.adam(rows, BETA1, BETA2, EPS, loss)


def adam_steps_twin(moves: Sequence[Move]) -> None:
    """Make all the moves in place, in plain torch, on any device and dtype."""
    for tensor, gradient, first, second, step, rate, gate in moves:
        m = first * BETA1 + gradient * (1 - BETA1)
        v = second * BETA2 + gradient.square() * (1 - BETA2)
        move = rate / (1 - BETA1**step) * m / ((v / (1 - BETA2**step)).sqrt() + EPS)
        if gate is not None:
            gate.trace.copy_(move)
            factor = gate.multipliers.to(tensor.dtype).reshape(-1, *[1] * (tensor.dim() - 1))
            moved = factor != 0
            move = torch.where(moved, factor * move, 0.0)
            m, v = torch.where(moved, m, first), torch.where(moved, v, second)
        tensor -= move
        first.copy_(m)
        second.copy_(v)
