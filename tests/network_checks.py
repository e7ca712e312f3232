"""Random small networks, for the tests of those who compute them."""

from __future__ import annotations

from itertools import pairwise

import torch
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.ops.network import Layer


def tensors_of(widths: list[int], seed: int = 0) -> list[Tensor]:
    """Return weight and bias of each layer, all random."""
    rng, tensors = generator(seed), []
    for inputs, outputs in pairwise(widths):
        tensors.append(torch.randn(inputs, outputs, generator=rng) / inputs**0.5)
        tensors.append(torch.randn(outputs, generator=rng) * 0.3)
    return tensors


def layers_of(tensors: list[Tensor]) -> list[Layer]:
    return [Layer(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]
