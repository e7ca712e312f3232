"""4D-GS (Wu et al., CVPR 2024): a HexPlane over space and time, decoded by a small network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.limits import require_multiples
from gsdmsr_cli.model.motion._grids import split_times, time_nodes
from gsdmsr_cli.model.motion._limits import require_degree, require_levels
from gsdmsr_cli.model.parameter import name_parameters
from gsdmsr_cli.ops import network, planes
from gsdmsr_cli.ops.displace import OUTPUTS, PARTS, displace


@dataclass(frozen=True)
class Options:
    """Settings of the field and its regularisers.

    Attributes:
        levels: resolution of each of 1 to 8 levels along a spatial axis.
        channels: features per level, a multiple of 16.
        time_ratio: resolution in time per distinct train time.
        time_degree: of the B-splines between the nodes in time, 1 (straight lines) or 3.
        width: width of the network's hidden layers, a multiple of 16.
        heads: "shared" has two hidden layers; in "separate", as in 4D-GS, position, rotation and
            scale have a second hidden layer each.
        detach: keep the field's gradient from the canonical positions.
        space_smoothness, time_smoothness, time_stillness: weights of the plane regularisers.
    """

    levels: tuple[int, ...] = (64, 128)
    channels: int = 32
    time_ratio: float = 0.25
    time_degree: int = 1
    width: int = 64
    heads: Literal["shared", "separate"] = "shared"
    detach: bool = False
    space_smoothness: float = 1e-4
    time_smoothness: float = 1e-2
    time_stillness: float = 1e-4

    def __post_init__(self) -> None:
        require_levels(self, "levels")
        require_degree(self, "time_degree")
        require_multiples(self, "channels", "width")


class HexPlaneMotion(Layer):
    """x, q and log s plus offsets read from one grid of several levels (4D-GS, section 4)."""

    constants = ()

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options, self.facts = options, facts
        times = time_nodes(facts.frames, options.time_ratio)
        self.levels = planes.new_levels(options.levels, times, options.channels, generator)
        features = options.channels * len(options.levels)
        separate = options.heads == "separate"
        second = options.width * (len(PARTS) if separate else 1)
        widths = [features, options.width, second, OUTPUTS]
        self.layers = network.new_network(widths, generator)
        blocks = [torch.ones(options.width, outputs) for outputs in PARTS]
        self._own = torch.block_diag(*blocks) if separate else None
        super().__init__(
            name_parameters(
                "grid", self.levels, "planes", planes.TIME_AXES, time_degree=options.time_degree
            )
            + name_parameters("network", self.layers, "network")
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the deformed splats; time is mapped to the whole grid, [-1, 1]."""
        return self.at_instants(moment, [instant])[0]

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return the deformed splats at several times."""
        splats = moment.splats
        points = splats.means.detach() if self.options.detach else splats.means
        times = [instant.time for instant in instants]
        given = self.levels, points, times, self.facts.box, None
        features = planes.lookup_at_times(*given, planes.evenly, self.options.time_degree)
        deformations = network.apply_network(self._network(), features)
        parts = split_times(deformations, len(times))
        return [replace(moment, splats=displace(splats, own)) for own in parts]

    def _network(self) -> list[network.Layer]:
        """Return the layers, of which the last reads for each output its own head alone."""
        if self._own is None:
            return self.layers
        *layers, last = self.layers
        self._own = self._own.to(last.weight.device)  # the model may have moved to a device
        return [*layers, network.Layer(last.weight * self._own, last.bias)]

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Return the plane regularisers."""
        o = self.options
        return planes.penalty(self.levels, o.space_smoothness, o.time_smoothness, o.time_stillness)

    def check(self) -> None:
        """Raise ValueError unless grid and network fit together."""
        planes.check_levels(self.levels)
        network.check_network(self.layers, planes.features_of(self.levels), OUTPUTS)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> HexPlaneMotion:
    """Return a motion that is the identity until its network's last layer has been trained."""
    return HexPlaneMotion(options, facts, generator)
