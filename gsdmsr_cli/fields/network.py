"""A small fully connected network with ReLU between its layers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.kernels import linear as kernels
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
    for inputs, outputs in zip(widths[:-1], widths[1:], strict=True):
        spread = (2.0 / inputs) ** 0.5
        weight = torch.randn(inputs, outputs, generator=generator) * spread
        layers.append(Layer(weight, torch.zeros(outputs)))
    last = layers[-1]
    layers[-1] = Layer(torch.zeros_like(last.weight), last.bias)
    return layers


def apply_network(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return the network's output (N, outputs) for the inputs (N, inputs)."""
    tensors = [tensor for layer in layers for tensor in layer]
    if has_kernels(x, *tensors):
        y: Tensor = _Network.apply(x.contiguous(), *tensors)
        return y
    return apply_network_twin(layers, x)


def apply_network_twin(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return what ``apply_network`` does, in plain torch, for any device and dtype."""
    for weight, bias in layers[:-1]:
        x = torch.relu(x @ weight + bias)
    return x @ layers[-1].weight + layers[-1].bias


def _widened(layer: Layer) -> Layer:
    """Return the layer with zero columns up to a multiple of 16 outputs."""
    missing = -layer.weight.shape[1] % LANES
    if not missing:
        return layer
    pad = torch.nn.functional.pad
    return Layer(pad(layer.weight, (0, missing)), pad(layer.bias, (0, missing)))


class _Network(Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *tensors: Tensor) -> Tensor:
        layers = [Layer(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]
        outputs = layers[-1].weight.shape[1]
        layers[-1] = _widened(layers[-1])
        activations = [x]
        for number, (weight, bias) in enumerate(layers, start=1):
            y = torch.empty(len(x), weight.shape[1])
            relu = number < len(layers)
            kernels.linear(array(activations[-1]), array(weight), array(bias), relu, array(y))
            activations.append(y)
        ctx.weights = [layer.weight for layer in layers]
        ctx.save_for_backward(*activations[:-1])
        return activations[-1][:, :outputs]

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, ...]:
        activations = ctx.saved_tensors
        outputs = d_out.shape[1]
        d_y = torch.nn.functional.pad(d_out, (0, -outputs % LANES)).contiguous()
        gradients: list[Tensor] = []
        for number in reversed(range(len(activations))):
            x, weight = activations[number], ctx.weights[number]
            d_weight = torch.empty(kernels.BLOCKS, *weight.shape)
            d_bias = torch.empty(kernels.BLOCKS, weight.shape[1])
            kernels.linear_backward_weight(array(x), array(d_y), array(d_weight), array(d_bias))
            gradients += [d_bias.sum(0), d_weight.sum(0)]
            if number or ctx.needs_input_grad[0]:
                d_x = torch.empty_like(x)
                weight_t = weight.T.contiguous()
                kernels.linear_backward_input(
                    array(d_y), array(weight_t), array(x), number > 0, array(d_x)
                )
                d_y = d_x
        last_bias, last_weight = gradients[0], gradients[1]
        gradients[:2] = [last_bias[:outputs], last_weight[:, :outputs].contiguous()]
        return d_y if ctx.needs_input_grad[0] else None, *reversed(gradients)
