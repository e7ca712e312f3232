"""A small fully connected network in plain torch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.ops.network.layers import Layer


def apply_network_twin(layers: Sequence[Layer], x: Tensor) -> Tensor:
    """Return what ``apply_network`` does, in plain torch, for any device and dtype."""
    x = x[:, : len(layers[0].weight)]
    for weight, bias in layers[:-1]:
        x = torch.relu(torch.addmm(bias, x, weight))
    return torch.addmm(layers[-1].bias, x, layers[-1].weight)
