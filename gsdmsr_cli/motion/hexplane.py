"""4D-GS (Wu et al., CVPR 2024): a HexPlane over space and time, decoded by a small network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gsdmsr_cli.fields import network, planes
from gsdmsr_cli.fields.deformation import (
    OUTPUTS,
    PARTS,
    displace,
    name_tensors,
    split_times,
    time_nodes,
    trained,
)
from gsdmsr_cli.motion import Facts
from gsdmsr_cli.splats import Splats


@dataclass(frozen=True)
class Options:
    """Settings of the field and its regularisers.

    Attributes:
        levels: spatial nodes of each level along an axis.
        channels: features per level, a multiple of 16.
        time_ratio: nodes in time per distinct train time.
        width: width of the network's hidden layers, a multiple of 16.
        heads: "shared" has two hidden layers; in "separate", as in 4D-GS, position, rotation and
            scale have a second hidden layer each.
        detach: keep the field's gradient from the canonical positions.
        space_smoothness, time_smoothness, time_stillness: weights of the plane regularisers.
    """

    levels: tuple[int, ...] = (64, 128)
    channels: int = 32
    time_ratio: float = 0.25
    width: int = 64
    heads: Literal["shared", "separate"] = "shared"
    detach: bool = False
    space_smoothness: float = 1e-4
    time_smoothness: float = 1e-2
    time_stillness: float = 1e-4


class HexPlaneMotion:
    """x, q and log s plus offsets read from one grid of several levels (4D-GS, section 4)."""

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options, self.facts = options, facts
        times = time_nodes(facts.frames, options.time_ratio)
        self.levels = [
            trained(planes.new_level(resolution, times, options.channels, generator))
            for resolution in options.levels
        ]
        features = options.channels * len(options.levels)
        separate = options.heads == "separate"
        second = options.width * (len(PARTS) if separate else 1)
        widths = [features, options.width, second, OUTPUTS]
        self.layers = [trained(layer) for layer in network.new_network(widths, generator)]
        blocks = [torch.ones(options.width, outputs) for outputs in PARTS]
        self._own = torch.block_diag(*blocks) if separate else None

    def at(self, splats: Splats, time: float) -> Splats:
        """Return the deformed splats; time is mapped to the whole grid, [-1, 1]."""
        return self.at_times(splats, [time])[0]

    def at_times(self, splats: Splats, times: Sequence[float]) -> list[Splats]:
        """Return the deformed splats at several times."""
        points = splats.means.detach() if self.options.detach else splats.means
        moments = [2 * time - 1 for time in times]
        features = planes.lookup_at_times(self.levels, points, moments, self.facts.box)
        deformations = network.apply_network(self._network(), features)
        return [displace(splats, own) for own in split_times(deformations, len(times))]

    def _network(self) -> list[network.Layer]:
        """Return the layers, of which the last reads for each output its own head alone."""
        if self._own is None:
            return self.layers
        *layers, last = self.layers
        self._own = self._own.to(last.weight.device)  # where the model has gone meanwhile
        return [*layers, network.Layer(last.weight * self._own, last.bias)]

    def take(self, rows: Tensor) -> None:
        """Hold nothing per splat."""

    def advance(self, progress: float) -> None:
        """Have no phases."""

    def penalty(self, splats: Splats, time: float, generator: torch.Generator) -> Tensor | None:
        """Return the plane regularisers."""
        o = self.options
        return planes.penalty(self.levels, o.space_smoothness, o.time_smoothness, o.time_stillness)

    def tensors(self) -> dict[str, Tensor]:
        """Return the grid and the network."""
        return name_tensors({"grid": self.levels}, {"network": self.layers})

    def groups(self) -> dict[str, str]:
        """Return which learning rate each tensor follows."""
        return {n: "planes" if n.startswith("grid") else "network" for n in self.tensors()}


def start(options: Options, facts: Facts, count: int, generator: torch.Generator) -> HexPlaneMotion:
    """Return a motion that is the identity until its network's last layer has learnt."""
    return HexPlaneMotion(options, facts, generator)
