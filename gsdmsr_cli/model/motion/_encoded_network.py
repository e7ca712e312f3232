"""A network that reads where something is and when, as sines and cosines of many frequencies.

The deformation network of Deformable-3DGS (Yang et al., CVPR 2024, section 3.2), which other
methods use for other points than splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.backends.cpu.simd import LANES
from gsdmsr_cli.model.parameter import Parameter, name_parameters
from gsdmsr_cli.ops import network
from gsdmsr_cli.ops.displace import OUTPUTS

MOST_OCTAVES = 16
"""Beyond it a float32 no longer tells the phases of a sine apart."""


def encode(values: Tensor, octaves: int) -> Tensor:
    """Return values (N, D) and their sines and cosines, (N, D (1 + 2 octaves)).

    gamma(p) = [p, sin(2^l p), cos(2^l p)] for l from 0 to octaves - 1, without a factor of pi
    (equation 4, as its code has it).
    """
    frequencies = 2.0 ** torch.arange(octaves, device=values.device)
    phases = (values[:, :, None] * frequencies).flatten(1)
    return torch.cat([values, phases.sin(), phases.cos()], dim=1)


@dataclass(frozen=True)
class Shape:
    """How large an encoded network is.

    Attributes:
        width: of its hidden layers, a multiple of 16.
        depth: number of its hidden layers, 2 or more.
        position_octaves, time_octaves: frequencies of the encodings.
    """

    width: int
    depth: int
    position_octaves: int
    time_octaves: int

    @property
    def inputs(self) -> int:
        """Columns of the encoding, rounded up to what kernels read."""
        columns = 3 * (1 + 2 * self.position_octaves) + 1 + 2 * self.time_octaves
        return columns + -columns % LANES

    @property
    def before_skip(self) -> int:
        """Hidden layers before the input joins again: 5 of 8, as in the paper's code."""
        return self.depth // 2 + 1


class EncodedNetwork(NamedTuple):
    """Hidden layers with ReLU; half way the encoding joins once more (the skip).

    Attributes:
        shape: how large it is.
        first: the layers before the skip.
        second: those after it, the last one without ReLU.
    """

    shape: Shape
    first: list[network.Layer]
    second: list[network.Layer]

    def parameters(self, name: str) -> list[Parameter]:
        """Return the layers as parameters "name.0.weight" and so on."""
        return name_parameters(name, [*self.first, *self.second], "network")

    def apply(self, points: Tensor, times: Sequence[float]) -> list[Tensor]:
        """Return the outputs (N, 10) for points (N, 3) at each of the times; see ``ops.displace``.

        Args:
            points: of about the unit cube: the lowest frequency is one radian a unit.
            times: in [0, 1].
        """
        where = encode(points, self.shape.position_octaves)
        return [self._at(where, time) for time in times]

    def _at(self, where: Tensor, time: float) -> Tensor:
        """Return the outputs for encoded points (N, K) at a time."""
        count, shape = len(where), self.shape
        when = encode(where.new_tensor([[time]]), shape.time_octaves)
        rest = shape.inputs - where.shape[1] - when.shape[1]
        inputs = torch.cat([where, when.expand(count, -1), where.new_zeros(count, rest)], dim=1)
        hidden = network.apply_network(self.first, inputs).relu()
        return network.apply_network(self.second, torch.cat([inputs, hidden], dim=1))

    def check(self) -> None:
        """Raise ValueError unless the layers lead from the encoding to the outputs."""
        inputs, width = self.shape.inputs, self.first[-1].weight.shape[1]
        network.check_network(self.first, inputs, width)
        network.check_network(self.second, inputs + width, OUTPUTS)


def new_encoded_network(shape: Shape, generator: torch.Generator) -> EncodedNetwork:
    """Return a network that starts as 0, whereas the paper's last layers start at random."""
    first = [shape.inputs, *[shape.width] * shape.before_skip, OUTPUTS]
    after = shape.depth - shape.before_skip
    second = [shape.inputs + shape.width, *[shape.width] * after, OUTPUTS]
    # a new network ends with a layer of zeros, which the part before the skip has not
    begun = network.new_network(first, generator)[:-1]
    return EncodedNetwork(shape, begun, network.new_network(second, generator))
