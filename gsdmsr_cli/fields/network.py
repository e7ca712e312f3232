"""A small fully connected network with ReLU between its layers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.cuda.launch import serves
from gsdmsr_cli.fields import half, precision
from gsdmsr_cli.fields.live import live_rows, spread
from gsdmsr_cli.kernels import network as kernels
from gsdmsr_cli.kernels.simd import LANES
from gsdmsr_cli.tensors import array, has_kernels


class Layer(NamedTuple):
    """A linear layer y = x weight + bias.

    Attributes:
        weight: (inputs, outputs).
        bias: (outputs,).
    """

    weight: Tensor
    bias: Tensor


def new_network(widths: Sequence[int], generator: torch.Generator) -> list[Layer]:
    """Return layers between the given widths, the last one zero so that the network starts as 0.

    Hidden weights are normal with variance 2 / inputs (He et al. 2015); all widths but the last
    must be multiples of 16.
    """
    if any(width % LANES for width in widths[:-1]):
        raise ValueError(f"widths {list(widths[:-1])} are not all multiples of {LANES}")
    layers = []
    for inputs, outputs in pairwise(widths):
        spread = (2.0 / inputs) ** 0.5
        weight = torch.randn(inputs, outputs, generator=generator) * spread
        layers.append(Layer(weight, torch.zeros(outputs)))
    last = layers[-1]
    layers[-1] = Layer(torch.zeros_like(last.weight), last.bias)
    return layers


def apply_network(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return the network's output (N, outputs) for the first columns of x (N, inputs or more)."""
    return apply_networks([layers], x)[0]


def apply_networks(networks: Sequence[Sequence[Layer]], x: Tensor) -> tuple[Tensor, ...]:
    """Return what each of the networks makes of the same x, see ``apply_network``.

    On a GPU hidden layers are computed in the format that ``precision`` says.
    """
    tensors = [tensor for layers in networks for layer in layers for tensor in layer]
    dtype = precision.chosen()
    if dtype is not torch.float32 and serves(x, *tensors):
        return tuple(half.apply_network(layers, x, dtype) for layers in networks)
    if has_kernels(x, *tensors):
        depths = [len(layers) for layers in networks]
        outputs: tuple[Tensor, ...] = _Networks.apply(x.contiguous(), depths, *tensors)
        return outputs
    return tuple(apply_network_twin(layers, x) for layers in networks)


def apply_network_twin(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return what ``apply_network`` does, in plain torch, for any device and dtype."""
    x = x[:, : len(layers[0].weight)]
    for weight, bias in layers[:-1]:
        x = torch.relu(torch.addmm(bias, x, weight))
    return torch.addmm(layers[-1].bias, x, layers[-1].weight)


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
        x, *saved = ctx.saved_tensors
        kept, tensors = saved[: len(ctx.depths)], saved[len(ctx.depths) :]
        count, rows = len(x), live_rows(torch.cat(d_results, dim=1))
        if rows is not None:
            x, d_results = x[rows], tuple(d[rows] for d in d_results)
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
        if wanted and rows is not None:
            d_x = spread(d_x, rows, count)
        return d_x if wanted else None, None, *gradients


def _pick(outputs: Tensor, count: int, rows: Tensor, widths: Sequence[int]) -> Tensor:
    """Return the rows of all layers' outputs, laid out as ``kernels.forward`` does."""
    layers = zip(outputs.split([count * width for width in widths]), widths, strict=True)
    return torch.cat([layer.view(count, width)[rows].flatten() for layer, width in layers])


def _split(tensors: Sequence[Tensor], depths: Sequence[int]) -> list[Sequence[Tensor]]:
    """Return the tensors of each network, two for a layer."""
    ends = [2 * end for end in accumulate(depths)]
    return [tensors[end - 2 * depth : end] for end, depth in zip(ends, depths, strict=True)]
