"""Grid4D (Xu et al., NeurIPS 2024): hash grids over space and over planes with time, gated.

Space and time are decomposed into a static grid over xyz and three over xyt, xzt and yzt. A score
of the static features, from -1 to 1, gates what a network makes of the temporal ones. Here a
decoder turns the gated features into offsets, as for the other fields (4D-GS, equation 7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.limits import require_hash_levels, require_hash_sizes, require_multiples
from gsdmsr_cli.model.motion._grids import split_times
from gsdmsr_cli.model.parameter import Parameter, name_parameters
from gsdmsr_cli.ops import hash_grid, network, planes
from gsdmsr_cli.ops.displace import OUTPUTS, displace
from gsdmsr_cli.options.strict import require

_PLANES = ((0, 1, 3), (0, 2, 3), (1, 2, 3))
"""Which of x, y, z and t each of the temporal grids has."""

TIME_SHARE = 0.9
"""Share of the temporal grids that the whole of time takes."""


@dataclass(frozen=True)
class Options:
    """Settings of the grids, the networks and the perturbation loss.

    Attributes:
        space_levels: levels of the grid over space, 1 to 32.
        space_resolutions: of its first and its last level along each axis.
        time_levels: levels of each of the three grids over a plane and time, 1 to 32.
        plane_resolutions: of their first and last level along both spatial axes.
        time_resolutions: of their first and last level in time.
        features: of each level, 1 to 8; times the levels a multiple of 16, for both kinds.
        log2_rows: binary logarithm of the rows that a level's table has at most, 4 to 24.
        width: width of the networks' hidden layers, a multiple of 16.
        rate: learning rate of the grids, [start, end].
        smoothness: weight of the perturbation loss, the mean squared difference between gated
            features of splats and beside them, in space and time; 0 is off.
        reach: how far beside at most, in units of the bound.
        time_reach: likewise in time, in units of the whole.
        share: of the splats, of which it is computed.
    """

    space_levels: int = 8
    space_resolutions: tuple[int, int] = (16, 256)
    time_levels: int = 8
    plane_resolutions: tuple[int, int] = (8, 32)
    time_resolutions: tuple[int, int] = (8, 16)
    features: int = 2
    log2_rows: int = 15
    width: int = 64
    rate: tuple[float, float] = (5e-3, 5e-4)
    smoothness: float = 0.5
    reach: float = 1e-2
    time_reach: float = 1e-3
    share: float = 0.1

    def __post_init__(self) -> None:
        require_hash_levels(self, "space_levels", "features")
        require_hash_levels(self, "time_levels", "features")
        require_hash_sizes(self, "space_resolutions", "plane_resolutions", "time_resolutions")
        require_multiples(self, "width")
        require(self, "rate", min(self.rate) > 0, "[start, end], both above 0")
        for key in ("smoothness", "reach", "time_reach"):
            require(self, key, getattr(self, key) >= 0, "0 or more")
        require(self, "share", 0 < self.share <= 1, "above 0, at most 1")


class HashGridMotion(Layer):
    """x, q and log s plus offsets decoded from a(xyz) * relu(g(xyt, xzt, yzt)), a = 2 s - 1."""

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options = o = options
        self._to_cube = planes.to_cube(facts.box).astype("float32")
        self._reach = o.reach * facts.bound
        low, high = ([size] * 3 for size in o.space_resolutions)
        self.space_levels = hash_grid.new_levels(low, high, o.space_levels, o.log2_rows)
        low, high = (
            [plane, plane, time]
            for plane, time in zip(o.plane_resolutions, o.time_resolutions, strict=True)
        )
        self.time_levels = hash_grid.new_levels(low, high, o.time_levels, o.log2_rows)
        self.space = hash_grid.new_table(self.space_levels, o.features, generator)
        self.times = [hash_grid.new_table(self.time_levels, o.features, generator) for _ in _PLANES]
        spatial, temporal = o.space_levels * o.features, 3 * o.time_levels * o.features
        self.gate = _hidden([spatial, o.width, o.width], generator)
        self.encoder = _hidden([temporal, o.width, o.width], generator)
        self.decoder = network.new_network([o.width, o.width, OUTPUTS], generator)
        tables = {"space": self.space} | {f"time.{i}": t for i, t in enumerate(self.times)}
        super().__init__(
            [Parameter(name, table, rate=o.rate) for name, table in tables.items()]
            + name_parameters("gate", self.gate, "network")
            + name_parameters("encoder", self.encoder, "network")
            + name_parameters("decoder", self.decoder, "network")
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the deformed splats."""
        return self.at_instants(moment, [instant])[0]

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return the deformed splats at several times; what does not depend on time is read once.

        The positions that are asked for get no gradient from the grids, as in the paper's code.
        """
        places, count = self._placed(moment.splats.means.detach()), len(instants)
        times = [places.new_full((len(places), 1), instant.time) for instant in instants]
        gate, encoded = self._gate(places), self._encode(places.repeat(count, 1), torch.cat(times))
        gated = (gate.repeat(count, 1) if count > 1 else gate) * encoded
        parts = split_times(network.apply_network(self.decoder, gated), count)
        return [replace(moment, splats=displace(moment.splats, own)) for own in parts]

    def _placed(self, means: Tensor) -> Tensor:
        """Return where means (N, 3) are in the grids, [-1, 1] along every axis of the box."""
        scale, shift = means.new_tensor(self._to_cube)
        placed: Tensor = means * scale + shift
        return placed

    def _gate(self, places: Tensor) -> Tensor:
        """Return the scores (N, width), from -1 to 1: twice a sigmoid less 1 is a tanh."""
        features = hash_grid.lookup(self.space_levels, self.space, places)
        return torch.tanh(0.5 * network.apply_network(self.gate, features))

    def _encode(self, places: Tensor, times: Tensor) -> Tensor:
        """Return the temporal features (N, width) of places (N, 3) at times (N, 1) in [0, 1]."""
        given = torch.cat([places, TIME_SHARE * (2 * times.clamp(0, 1) - 1)], dim=1)
        features = [
            hash_grid.lookup(self.time_levels, table, given[:, axes])
            for table, axes in zip(self.times, _PLANES, strict=True)
        ]
        encoded: Tensor = network.apply_network(self.encoder, torch.cat(features, dim=1)).relu()
        return encoded

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return the perturbation loss at some of the splats, chosen at random."""
        o = self.options
        if o.smoothness == 0:
            return None
        means = moment.splats.means.detach()
        rows = torch.randint(
            len(means), (max(round(o.share * len(means)), 1),), generator=generator
        )
        offset = 2 * torch.rand(len(rows), 4, generator=generator) - 1
        here = means[rows.to(means.device)]
        beside = here + self._reach * offset[:, :3].to(here)
        places = self._placed(torch.cat([here, beside]))
        time = here.new_full((len(here), 1), instant.time)
        times = torch.cat([time, time + o.time_reach * offset[:, 3:].to(time)])
        one, other = (self._gate(places) * self._encode(places, times)).chunk(2)
        return o.smoothness * (one - other).square().mean()

    def check(self) -> None:
        """Raise ValueError unless tables and networks have the sizes of the options."""
        o = self.options
        for levels, table in (
            (self.space_levels, self.space),
            *((self.time_levels, table) for table in self.times),
        ):
            hash_grid.check_table(levels, table, o.features)
        width = self.decoder[0].weight.shape[0]
        network.check_network(self.gate, o.space_levels * o.features, width)
        network.check_network(self.encoder, 3 * o.time_levels * o.features, width)
        network.check_network(self.decoder, width, OUTPUTS)


def _hidden(widths: Sequence[int], generator: torch.Generator) -> list[network.Layer]:
    """Return layers that begin as the hidden ones of a network do, none of them as zero.

    Biases are uniform within +-1 / sqrt(inputs): without them the product of a score and a feature
    that both come from a table near 0 would have hardly a gradient.
    """
    layers = network.new_network([*widths, 1], generator)[:-1]
    for (_, bias), (inputs, _) in zip(layers, pairwise(widths), strict=True):
        bias.uniform_(-(inputs**-0.5), inputs**-0.5, generator=generator)
    return layers


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> HashGridMotion:
    """Return a motion that is the identity until its decoder's last layer has been trained."""
    return HashGridMotion(options, facts, generator)
