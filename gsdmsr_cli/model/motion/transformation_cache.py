"""A hash grid and a network say how all splats are displaced and turned from moment to moment.

The neural transformation cache of 3DGStream (Sun et al., CVPR 2024, section 3.2). At each moment
it is trained anew from what it was, so it begins with the motion of the last one; as the moment
ends, what it says is added to the splats, and that is what is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.limits import require_hash_levels, require_hash_sizes, require_multiples
from gsdmsr_cli.model.motion._arcs import added_to_none, turned
from gsdmsr_cli.model.motion._streamed import Knot, Streamed
from gsdmsr_cli.model.parameter import Parameter, name_parameters
from gsdmsr_cli.ops import hash_grid, network, planes
from gsdmsr_cli.ops.finite import all_finite
from gsdmsr_cli.options.strict import require_rates

STREAMED = True
"""It is learnt moment after moment."""

_OUTPUTS = 3 + 4


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        levels: of the grid, 1 to 32.
        resolutions: of its first and its last level along each axis.
        features: of each level, 1 to 8; times the levels a multiple of 16.
        log2_rows: binary logarithm of the rows that a level's table has at most, 4 to 24.
        width: of the network's two hidden layers, a multiple of 16.
        rate: learning rate of grid and network at the start and the end of a moment.
    """

    levels: int = 8
    resolutions: tuple[int, int] = (8, 256)
    features: int = 4
    log2_rows: int = 15
    width: int = 32
    rate: tuple[float, float] = (2e-3, 2e-4)

    def __post_init__(self) -> None:
        require_hash_levels(self, "levels", "features")
        require_hash_sizes(self, "resolutions")
        require_multiples(self, "width")
        require_rates(self, "rate")


class TransformationCache(Streamed):
    """What splats are at the last moment plus (d, q) decoded from the grid there; rows are splats.

    Attributes:
        table, network: the grid and what decodes it.
        pending: (), 1 until a moment is over: what grid and network say is not yet in
            ``offsets`` and ``turns``, which are those that the moment began with.
    """

    def __init__(
        self, options: Options, facts: Facts, count: int, generator: torch.Generator
    ) -> None:
        self.options = o = options
        self._to_cube = planes.to_cube(facts.box).astype("float32")
        low, high = ([size] * 3 for size in o.resolutions)
        self.levels = hash_grid.new_levels(low, high, o.levels, o.log2_rows)
        self.table = hash_grid.new_table(self.levels, o.features, generator)
        widths = [o.levels * o.features, o.width, o.width, _OUTPUTS]
        self.network = network.new_network(widths, generator)
        self.pending = torch.ones((), dtype=torch.uint8)
        trained = [
            Parameter("table", self.table, rate=o.rate),
            *name_parameters("network", self.network, o.rate),
        ]
        self.learnt = [parameter.name for parameter in trained]
        own = [*trained, Parameter("pending", self.pending)]
        super().__init__(facts, count, True, (None, None), own)

    def of_splats(self, means: Tensor, index: int) -> Knot:
        """Return the rows, and at a moment that is learnt what grid and network add to them."""
        rows = self.knot(index)
        if not (self.is_newest(index) and self.pending):
            return rows
        scale, shift = means.new_tensor(self._to_cube)
        places = (means.detach() + self.bound * rows.offsets) * scale + shift
        features = hash_grid.lookup(self.levels, self.table, places)
        added = network.apply_network(self.network, features)
        turns = quat_product(turned(added[:, 3:]), turned(rows.turns))
        return Knot(rows.offsets + added[:, :3], added_to_none(turns))

    @torch.no_grad()
    def go_on(self, first: float, last: float, time: float, share: float) -> None:
        """See ``Streamed.go_on``; grid and network go on with the last motion by themselves."""
        super().go_on(first, last, time, 0.0)
        self.pending.fill_(1)

    @torch.no_grad()
    def settle(self, splats: Splats, first: bool) -> None:
        """See ``Streamed.settle``."""
        if self.pending:
            found = self.of_splats(splats.means, len(self.times) - 1)
            self.offsets.copy_(found.offsets)
            self.turns.copy_(found.turns)
            self.pending.zero_()
        super().settle(splats, first)

    @torch.no_grad()
    def mend(self) -> Mapping[str, Tensor]:
        """Let what is not finite of grid and network be 0."""
        tensors = self.tensors()
        learnt = {name: tensors[name] for name in self.learnt}
        if all_finite(list(learnt.values())):  # asked in every step
            return {}
        lost = {name: ~own.isfinite() for name, own in learnt.items()}
        for name, own in learnt.items():
            own[lost[name]] = 0
        return {name: rows for name, rows in lost.items() if rows.any()}

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """See ``Layer.restore``; moments' files have neither grid nor network, and need none."""
        if "pending" not in tensors:
            own = {name: t for name, t in self.tensors().items() if name in self.learnt}
            tensors = {**tensors, **own, "pending": torch.zeros_like(self.pending)}
        super().restore(tensors, count)

    def check(self) -> None:
        """Raise ValueError unless grid and network have the sizes of the options, too."""
        super().check()
        o = self.options
        hash_grid.check_table(self.levels, self.table, o.features)
        network.check_network(self.network, o.levels * o.features, _OUTPUTS)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> TransformationCache:
    """Return a motion that is the identity until it has been trained."""
    return TransformationCache(options, facts, len(splats), generator)
