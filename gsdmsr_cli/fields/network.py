"""A small fully connected network with ReLU between its layers."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
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


class _Packed:
    """The layers as the kernels want them: flat, the last one widened to a multiple of 16.

    Attributes:
        widths: (L + 1,) of the inputs and of every layer's output.
        weights, biases: of all layers.
    """

    def __init__(self, layers: Sequence[Layer]) -> None:
        weights = [_widened(layer.weight) for layer in layers]
        self.widths = np.array([len(weights[0]), *(w.shape[1] for w in weights)], np.int64)
        self.weights = np.concatenate([weight.ravel() for weight in weights])
        self.biases = np.concatenate([_widened(layer.bias) for layer in layers])

    def layers(self, flat: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Return the views (in, out) of flat weights."""
        shapes = list(pairwise(int(width) for width in self.widths))
        ends = np.cumsum([inputs * outputs for inputs, outputs in shapes])[:-1]
        return [part.reshape(s) for part, s in zip(np.split(flat, ends), shapes, strict=True)]

    def turned(self) -> NDArray[np.float32]:
        """Return the weights, every layer's as (out, in)."""
        return np.concatenate([weight.T.ravel() for weight in self.layers(self.weights)])


def _widened(tensor: Tensor) -> NDArray[np.float32]:
    """Return the values with zeros up to a multiple of 16 columns."""
    values, columns = array(tensor), tensor.shape[-1]
    result = np.zeros((*values.shape[:-1], columns + -columns % LANES), np.float32)
    result[..., :columns] = values
    return result


class _Network(Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *tensors: Tensor) -> Tensor:
        layers = [Layer(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]
        packed = _Packed(layers)
        outputs = torch.empty(len(x) * int(packed.widths[1:].sum()))
        kernels.forward(array(x), packed.widths, packed.weights, packed.biases, array(outputs))
        ctx.packed, ctx.shapes = packed, [tensor.shape for tensor in tensors]
        ctx.save_for_backward(x, outputs)
        width = int(packed.widths[-1])
        y = outputs[len(outputs) - len(x) * width :].view(len(x), width)
        return y[:, : layers[-1].weight.shape[1]]

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_out: Tensor) -> tuple[Tensor | None, ...]:
        x, outputs = ctx.saved_tensors
        packed: _Packed = ctx.packed
        wanted = ctx.needs_input_grad[0]
        d_x = torch.empty_like(x) if wanted else torch.empty(0, 0)
        d_weights = np.empty((kernels.BLOCKS, len(packed.weights)), np.float32)
        d_biases = np.empty((kernels.BLOCKS, len(packed.biases)), np.float32)
        kernels.backward(
            array(x), packed.widths, packed.turned(), array(outputs), _widened(d_out),
            d_weights, d_biases, array(d_x),
        )  # fmt: skip
        weights = packed.layers(d_weights.sum(0))
        biases = np.split(d_biases.sum(0), np.cumsum(packed.widths[1:-1]))
        both = (part for pair in zip(weights, biases, strict=True) for part in pair)
        gradients = (
            torch.from_numpy(part[..., : shape[-1]].copy())
            for part, shape in zip(both, ctx.shapes, strict=True)
        )
        return d_x if wanted else None, *gradients
