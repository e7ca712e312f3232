"""Adam over named tensors, with a step multiplier per row and a true skip of rows."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from gsdmsr_cli.model.parameter import below, take_rows
from gsdmsr_cli.ops.adam import Gate, Move, adam_steps

_FIRST, _SECOND = "first.", "second."


class Adam:
    """First and second moments of every tensor that has had a gradient (Kingma & Ba 2015).

    Attributes:
        first, second: moments by the tensor's name.
        steps: how many steps each tensor has made since its second moment began.
        restarts: after how many of those its first moment began anew, where it did.
    """

    def __init__(self) -> None:
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}
        self.steps: dict[str, int] = {}
        self.restarts: dict[str, int] = {}

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
                finite, so that nobody has to wait for it. Elsewhere the caller checks it.
        """
        moves = []
        for name, tensor in tensors.items():
            if tensor.grad is None:
                continue
            if name not in self.first:
                self.first[name], self.second[name] = (torch.zeros_like(tensor) for _ in "12")
                self.steps[name] = 0
            self.steps[name] += 1
            moments = self.first[name], self.second[name]
            gradient = tensor.grad.contiguous()
            gate = (gates or {}).get(name)
            count, before = self.steps[name], self.restarts.get(name, 0)
            moves.append(Move(tensor, gradient, *moments, count, rates[name], gate, before))
            tensor.grad = None
        adam_steps(moves, loss)

    def take(self, name: str, rows: Tensor, fresh: Tensor) -> None:
        """Follow a resize of the named tensor; rows that are ``fresh`` (M,) start without moments.

        So do rows that the tensor has not had, of splats that begin to move.
        The step count is shared by all rows and goes on.
        """
        for moments in (self.first, self.second):
            if name in moments:
                taken = take_rows(moments[name], rows, 0.0)
                taken[fresh] = 0
                moments[name] = taken

    def reset_momentum(self, name: str, rows: Tensor) -> None:
        """Set the momentum of the given rows (M,) of the named tensor to zero."""
        if name in self.first:
            self.first[name][rows] = 0

    def reset_moments(self, name: str, second: bool = True) -> None:
        """Set the tensor's first moment to zero, and its second if ``second``.

        Each moment is a mean over the steps since it was zero, for which Adam corrects by their
        number (Kingma & Ba 2015, section 3): so that number begins anew with it. A first moment
        alone would otherwise make the next steps too short, both together too long by
        (1 - beta1) / sqrt(1 - beta2) = 3.16.
        """
        if name not in self.steps:
            return
        self.first[name].zero_()
        self.restarts[name] = self.steps[name]
        if second:
            self.second[name].zero_()
            self.steps[name] = self.restarts[name] = 0

    def forget(self, name: str) -> None:
        """Drop all that is kept of a tensor which is not trained any more."""
        for kept in (self.first, self.second, self.steps, self.restarts):
            kept.pop(name, None)

    def tensors(self) -> dict[str, Tensor]:
        """Return the moments by name; the step counts are numbers, to be kept elsewhere."""
        first = {_FIRST + name: tensor for name, tensor in self.first.items()}
        return first | {_SECOND + name: tensor for name, tensor in self.second.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""
        self.first, self.second = below(_FIRST, tensors), below(_SECOND, tensors)
