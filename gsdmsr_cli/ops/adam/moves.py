"""What one step of Adam does to one tensor (Kingma & Ba 2015)."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15


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
        before: how many of the steps were made before the first moment began anew.
    """

    tensor: Tensor
    gradient: Tensor
    first: Tensor
    second: Tensor
    step: int
    rate: float
    gate: Gate | None = None
    before: int = 0

    def factors(self) -> tuple[float, float]:
        """Return the rate over the first moment's bias correction, and 1 over the second's."""
        first, second = 1 - BETA1 ** (self.step - self.before), 1 - BETA2**self.step
        return self.rate / first, 1 / second
