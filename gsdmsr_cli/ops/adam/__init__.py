"""Adam's steps over many tensors at once, with a multiplier per row and a true skip of rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from gsdmsr_cli.ops.adam import cpu as kernels
from gsdmsr_cli.ops.adam import cuda
from gsdmsr_cli.ops.adam.moves import BETA1, BETA2, EPS, Gate, Move
from gsdmsr_cli.ops.adam.twin import adam_steps_twin
from gsdmsr_cli.ops.choose import choose

__all__ = ["Gate", "Move", "adam_steps", "adam_steps_cpu", "adam_steps_cuda", "adam_steps_twin"]


def adam_steps(moves: Sequence[Move], loss: Tensor | None = None) -> None:
    """Make all the moves in place; nothing on a GPU if the ``loss``, (), is not finite there."""
    by_form: dict[str, list[Move]] = {"cpu": [], "cuda": [], "twin": []}
    for move in moves:
        by_form[choose(move.tensor)].append(move)
    adam_steps_cpu(by_form["cpu"])
    adam_steps_cuda(by_form["cuda"], loss)
    adam_steps_twin(by_form["twin"])


def adam_steps_cpu(moves: Sequence[Move]) -> None:
    """Make all the moves in place, by one kernel on the CPU."""
    if not moves:
        return
    table, steps = np.empty((len(moves), 8), np.int64), np.empty((len(moves), 2), np.float32)
    for i, move in enumerate(moves):
        tensor, gradient, first, second, _, _, gate, _ = move
        addresses = (t.data_ptr() for t in (tensor, gradient, first, second))
        gated = gate is not None and tensor.numel() > 0
        width = tensor.numel() // len(tensor) if gated else 0
        gates = (t.data_ptr() for t in gate) if gate is not None else (0, 0)
        table[i] = *addresses, tensor.numel(), width, *gates
        steps[i] = move.factors()
    kernels.adam(table, steps, *map(np.float32, (BETA1, BETA2, EPS)))


def adam_steps_cuda(moves: Sequence[Move], loss: Tensor | None = None) -> None:
    """Make all the moves in place, by one CUDA kernel, if the loss is finite."""
    rows = []
    for move in moves:
        gates = (None, None) if move.gate is None else tuple(move.gate)
        rows.append(cuda.Row(*move[:4], *move.factors(), *gates))
    cuda.adam(rows, BETA1, BETA2, EPS, loss)
