"""Adds to the colours of splats what is linear in how they have turned."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.lighting import cpu as kernels
from gsdmsr_cli.ops.lighting.twin import light_twin, turns_twin
from gsdmsr_cli.ops.series import add_series

__all__ = ["light", "light_twin"]


def light(sh: Tensor, slopes: Tensor, quats: Tensor, canonical_quats: Tensor) -> Tensor:
    """Return harmonics (N, K, 3), to the constant ones of which 2 v . slopes is added.

    With (w, v), w >= 0, the unit quaternion that turns the canonical rotation to the present one.
    There is no gradient of it for the rotations.

    Args:
        sh: (N, K, 3) harmonics.
        slopes: (N, 3, 3), axis of the turn and channel.
        quats, canonical_quats: (N, 4) rotations now and before, wxyz, not necessarily normalised.
    """
    given = sh, slopes, quats, canonical_quats
    form = choose(*given)
    if form == "cpu":
        lit: Tensor = _Light.apply(*given)
        return lit
    if form == "cuda":
        return add_series(sh.flatten(1), slopes, turns_twin(quats, canonical_quats)).view_as(sh)
    return light_twin(*given)


class _Light(Function):
    @staticmethod
    def forward(ctx: Any, sh: Tensor, slopes: Tensor, now: Tensor, before: Tensor) -> Tensor:
        given = (tensor.contiguous() for tensor in (sh, slopes, now, before))
        turns, lit = torch.empty(len(sh), 3), torch.empty_like(sh)
        kernels.light(*map(array, (*given, turns, lit)))
        ctx.save_for_backward(turns)
        return lit

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_lit: Tensor) -> tuple[Tensor | None, ...]:
        (turns,) = ctx.saved_tensors
        d_slopes = torch.empty(len(turns), 3, 3)
        kernels.light_backward(*map(array, (turns, d_lit.contiguous(), d_slopes)))
        return d_lit, d_slopes, None, None
