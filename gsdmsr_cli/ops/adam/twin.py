"""Adam's steps in plain torch."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from gsdmsr_cli.ops.adam.moves import BETA1, BETA2, EPS, Move


def adam_steps_twin(moves: Sequence[Move]) -> None:
    """Make all the moves in place, in plain torch, on any device and dtype."""
    for one in moves:
        tensor, gradient, first, second, _, _, gate, _ = one
        step, inverse2 = one.factors()
        m = first * BETA1 + gradient * (1 - BETA1)
        v = second * BETA2 + gradient.square() * (1 - BETA2)
        move = step * m / ((v * inverse2).sqrt() + EPS)
        if gate is not None:
            gate.trace.copy_(move)
            factor = gate.multipliers.to(tensor.dtype).reshape(-1, *[1] * (tensor.dim() - 1))
            moved = factor != 0
            move = torch.where(moved, factor * move, 0.0)
            m, v = torch.where(moved, m, first), torch.where(moved, v, second)
        tensor -= move
        first.copy_(m)
        second.copy_(v)
