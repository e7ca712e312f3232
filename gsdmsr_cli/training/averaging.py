"""Averages a model's tensors over the end of its training (Polyak & Juditsky 1992).

Single steps keep scattering around what they lead to. Their mean lies nearer, as if the learning
rate had fallen further, and serves unseen views and times better (Izmailov et al. 2018).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.model.parameter import Parameter

EVERY = 10
"""Steps between two values that are averaged: neighbours differ too little to be worth a pass."""


class Average:
    """The mean of the tensors added so far.

    Attributes:
        tensors: the means, by name; empty before the first.
        count: how many values each is the mean of.
    """

    def __init__(self) -> None:
        self.tensors: dict[str, Tensor] = {}
        self.count = 0

    @torch.no_grad()
    def add(self, parameters: Sequence[Parameter]) -> None:
        """Add present values; the names and shapes are those of the first call.

        Of what is not trained, the last values count.
        """
        self.count += 1
        for name, tensor, rate in ((p.name, p.tensor, p.rate) for p in parameters):
            if self.count == 1 or rate is None:
                self.tensors[name] = tensor.detach().clone()
            else:
                self.tensors[name].lerp_(tensor, 1 / self.count)

    def take(self, name: str, rows: Tensor) -> None:
        """Follow a resize of the named tensor that adds no splats."""
        if name in self.tensors:
            self.tensors[name] = self.tensors[name][rows]

    def clear(self) -> None:
        """Begin anew: after a change that makes earlier values worthless."""
        self.tensors, self.count = {}, 0
