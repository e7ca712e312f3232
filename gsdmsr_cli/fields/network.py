"""A small fully connected network with ReLU between its layers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

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
    tensors = [tensor for layer in layers for tensor in layer]
    if has_kernels(x, *tensors):
        y: Tensor = _Network.apply(x.contiguous(), *tensors)
        return y
    return apply_network_twin(layers, x)


def apply_network_twin(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return what ``apply_network`` does, in plain torch, for any device and dtype."""
    x = x[:, : len(layers[0].weight)]
    for weight, bias in layers[:-1]:
        x = torch.relu(x @ weight + bias)
    return x @ layers[-1].weight + layers[-1].bias


class _Network(Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *tensors: Tensor) -> Tensor:
        weights, biases = (tuple(map(array, part)) for part in (tensors[::2], tensors[1::2]))
        columns = [weight.shape[1] for weight in weights]
        width = columns[-1] + -columns[-1] % LANES
        outputs = torch.empty(len(x) * (sum(columns[:-1]) + width))
        kernels.forward(array(x), weights, biases, array(outputs))
        ctx.layers = weights, biases
        ctx.save_for_backward(x, outputs, *tensors)
        y = outputs[len(outputs) - len(x) * width :].view(len(x), width)
        return y[:, : columns[-1]]

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, ...]:
        x, outputs, *tensors = ctx.saved_tensors
        wanted = ctx.needs_input_grad[0]
        d_x = torch.empty_like(x) if wanted else torch.empty(0, 0)
        gradients = [torch.empty_like(tensor) for tensor in tensors]
        kernels.backward(
            array(x), *ctx.layers, array(outputs), array(d_out.contiguous()),
            tuple(map(array, gradients[::2])), tuple(map(array, gradients[1::2])), array(d_x),
        )  # fmt: skip
        return d_x if wanted else None, *gradients
