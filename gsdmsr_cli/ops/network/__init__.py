"""A small fully connected network with ReLU between its layers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cpu.simd import LANES
from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops import precision
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.live_rows import live_rows, spread
from gsdmsr_cli.ops.network import cpu as kernels
from gsdmsr_cli.ops.network import half
from gsdmsr_cli.ops.network.layers import Layer, check_network, new_network
from gsdmsr_cli.ops.network.twin import apply_network_twin

__all__ = [
    "Layer",
    "apply_network",
    "apply_network_twin",
    "apply_networks",
    "check_network",
    "new_network",
]


def apply_network(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return the network's output (N, outputs) for the first columns of x (N, inputs or more)."""
    return apply_networks([layers], x)[0]


def apply_networks(networks: Sequence[Sequence[Layer]], x: Tensor) -> tuple[Tensor, ...]:
    """Return what each of the networks makes of the same x, see ``apply_network``.

    On a GPU hidden layers are computed in the format that ``precision`` says.
    """
    tensors = [tensor for layers in networks for layer in layers for tensor in layer]
    dtype = precision.chosen()
    form = choose(x, *tensors)
    if form == "cuda" and dtype is not torch.float32:
        return tuple(half.apply_network(layers, x, dtype) for layers in networks)
    if form == "cpu":
        depths = [len(layers) for layers in networks]
        outputs: tuple[Tensor, ...] = _Networks.apply(x.contiguous(), depths, *tensors)
        return outputs
    return tuple(apply_network_twin(layers, x) for layers in networks)


class _Networks(Function):
    """Networks side by side, whose gradients by x are summed on the way."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, depths: Sequence[int], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.networks, ctx.widths, kept, results = [], [], [], []
        for own in _split(tensors, depths):
            layers = tuple(map(array, own[::2])), tuple(map(array, own[1::2]))
            columns = [weight.shape[1] for weight in layers[0]]
            widths = [*columns[:-1], columns[-1] + -columns[-1] % LANES]
            outputs = torch.empty(len(x) * sum(widths))
            kernels.forward(array(x), *layers, array(outputs))
            ctx.networks.append(layers)
            ctx.widths.append(widths)
            kept.append(outputs)
            y = outputs[len(outputs) - len(x) * widths[-1] :].view(len(x), widths[-1])
            results.append(y[:, : columns[-1]])
        ctx.depths = depths
        ctx.save_for_backward(x, *kept, *tensors)
        return tuple(results)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        given = torch.cat(d_results, dim=1)
        d_x, gradients = _Networks._differentiate(ctx, d_results, live_rows(given))
        # a row that is not finite spoils sums over all rows even if its gradient is 0
        if not all(bool(gradient.isfinite().all()) for gradient in gradients):
            d_x, gradients = _Networks._differentiate(ctx, d_results, live_rows(given, most=1.0))
        return d_x if ctx.needs_input_grad[0] else None, None, *gradients

    @staticmethod
    def _differentiate(
        ctx: Any, d_results: Sequence[Tensor], rows: Tensor | None
    ) -> tuple[Tensor, list[Tensor]]:
        """Return the gradients by x and by all tensors, from these rows alone or from all."""
        x, *saved = ctx.saved_tensors
        kept, tensors = saved[: len(ctx.depths)], saved[len(ctx.depths) :]
        count = len(x)
        if rows is not None:
            x, d_results = x[rows], [d[rows] for d in d_results]
            laid_out = zip(kept, ctx.widths, strict=True)
            kept = [_pick(outputs, count, rows, widths) for outputs, widths in laid_out]
        wanted = ctx.needs_input_grad[0]
        d_x = torch.empty_like(x) if wanted else torch.empty(0, 0)
        gradients = [torch.empty_like(tensor) for tensor in tensors]
        parts = zip(ctx.networks, kept, d_results, _split(gradients, ctx.depths), strict=True)
        for i, (layers, outputs, d_result, own) in enumerate(parts):
            kernels.backward(
                array(x), *layers, array(outputs), array(d_result.contiguous()),
                tuple(map(array, own[::2])), tuple(map(array, own[1::2])), array(d_x), i > 0,
            )  # fmt: skip
        return (spread(d_x, rows, count) if wanted and rows is not None else d_x), gradients


def _pick(outputs: Tensor, count: int, rows: Tensor, widths: Sequence[int]) -> Tensor:
    """Return the rows of all layers' outputs, laid out as ``kernels.forward`` does."""
    layers = zip(outputs.split([count * width for width in widths]), widths, strict=True)
    return torch.cat([layer.view(count, width)[rows].flatten() for layer, width in layers])


def _split(tensors: Sequence[Tensor], depths: Sequence[int]) -> list[Sequence[Tensor]]:
    """Return the tensors of each network, two for a layer."""
    ends = [2 * end for end in accumulate(depths)]
    return [tensors[end - 2 * depth : end] for end, depth in zip(ends, depths, strict=True)]
