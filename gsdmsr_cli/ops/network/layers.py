"""The layers of a small fully connected network, and how they begin."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.backends.cpu.simd import LANES


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


def check_network(layers: Sequence[Layer], inputs: int, outputs: int) -> None:
    """Raise ValueError unless the layers lead from so many inputs to so many outputs."""
    widths = [inputs, *(layer.weight.shape[1] for layer in layers)]
    fits = all(w.shape[0] == n for (w, _), n in zip(layers, widths, strict=False))
    fits = fits and all(tuple(bias.shape) == weight.shape[1:] for weight, bias in layers)
    if not fits or widths[-1] != outputs or any(width % LANES for width in widths[1:-1]):
        shapes = ", ".join(str(tuple(weight.shape)) for weight, _ in layers)
        raise ValueError(f"a network of shapes {shapes}, not one from {inputs} to {outputs}")
