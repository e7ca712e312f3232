"""A small network whose hidden layers are products of half-precision matrices, for GPUs.

The last layer is float32: what it returns moves splats, by less than half precision could say.

Gradients flow through hidden layers as bfloat16, whatever the format of the values. They are far
below those: of the mean over a million pixels, 1e-8 is common, and fp16 has nothing between 0 and
6e-8. Scaling them up would need a factor, found by waiting for the largest or by trial, and sums
over all rows, which gradients of weights are, overflow fp16 soon. bfloat16 has float32's range:
nothing vanishes, nothing overflows, and a relative error of 2^-9 in each is noise to Adam.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

_BACKWARD = torch.bfloat16


def apply_network(layers: Sequence[tuple[Tensor, Tensor]], x: Tensor, dtype: torch.dtype) -> Tensor:
    """Return what ``network.apply_network`` does, with hidden layers in ``dtype``."""
    tensors = [tensor for layer in layers for tensor in layer]
    result: Tensor = _Network.apply(x[:, : len(tensors[0])], dtype, *tensors)
    return result


class _Network(Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, dtype: torch.dtype, *tensors: Tensor) -> Tensor:
        *hidden, (last, offset) = zip(tensors[::2], tensors[1::2], strict=True)
        values = [x.to(dtype) if hidden else x]
        for weight, bias in hidden:
            product = torch.addmm(bias.to(dtype), values[-1], weight.to(dtype))
            values.append(product.relu_())
        ctx.save_for_backward(*tensors[::2], *values)
        return torch.addmm(offset, values[-1].float(), last)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_result: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        weights, values = saved[: len(saved) // 2], saved[len(saved) // 2 :]
        gradients = [values[-1].float().T @ d_result, d_result.sum(dim=0)]
        d = d_result @ weights[-1].T
        for i in reversed(range(len(weights) - 1)):
            d = d.to(_BACKWARD).masked_fill_(values[i + 1] <= 0, 0)
            d_weight = (values[i].to(_BACKWARD).T @ d).float()
            gradients = [d_weight, d.sum(dim=0, dtype=torch.float32), *gradients]
            d = d @ weights[i].to(_BACKWARD).T
        return d.float(), None, *gradients
