"""Colours from a field over space, not from splats (Compact 3DGS, Lee et al., CVPR 2024, 3.3).

A hash grid and a small network give each splat its colour by where its canonical centre is; what
it stores itself, one constant coefficient a channel, is not drawn and need not be kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.limits import require_hash_levels, require_hash_sizes, require_multiples
from gsdmsr_cli.model.parameter import Parameter, name_parameters
from gsdmsr_cli.ops import hash_grid, network, planes
from gsdmsr_cli.options.strict import require


@dataclass(frozen=True)
class Options:
    """Settings of the field.

    Attributes:
        levels: of the hash grid, 1 to 32; the paper has 16.
        features: of each level, 1 to 8; times the levels a multiple of 16.
        resolutions: of the first and the last level along each axis.
        log2_rows: binary logarithm of the rows that a level's table has at most, 4 to 24; the paper
            has 19 for real scenes, 16 for synthetic ones.
        width: of the network's two hidden layers, a multiple of 16.
        rate: learning rate of the grid and the network, [start, end].
    """

    levels: int = 16
    features: int = 2
    resolutions: tuple[int, int] = (16, 4096)
    log2_rows: int = 16
    width: int = 64
    rate: tuple[float, float] = (1e-2, 1e-3)

    def __post_init__(self) -> None:
        require_hash_levels(self, "levels", "features")
        require_hash_sizes(self, "resolutions")
        require_multiples(self, "width")
        require(self, "rate", min(self.rate) > 0, "[start, end], both above 0")


class Colour(Layer):
    """The constant harmonics of splats from a hash grid over contracted space."""

    identity_at_start = False
    concerns_still = True
    before_motion = True

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options = o = options
        self._to_cube = planes.to_cube(facts.box).astype("float32")
        low, high = ([size] * 3 for size in o.resolutions)
        self.levels = hash_grid.new_levels(low, high, o.levels, o.log2_rows)
        self.table = hash_grid.new_table(self.levels, o.features, generator)
        self.network = network.new_network([o.levels * o.features, o.width, o.width, 3], generator)
        super().__init__(
            [
                Parameter("table", self.table, rate=o.rate),
                *name_parameters("network", self.network, o.rate),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats with the field's colours, which give positions no gradient."""
        places = self._placed(moment.splats.means.detach())
        features = hash_grid.lookup(self.levels, self.table, places)
        sh = network.apply_network(self.network, features)[:, None]
        return replace(moment, splats=replace(moment.splats, sh=sh.contiguous()))

    def _placed(self, means: Tensor) -> Tensor:
        """Return where means (N, 3) are in the grid, [-1, 1]: all of space, contracted.

        The box is the inner half of it; what lies at r > 1 times that goes to 2 - 1 / r
        (Mip-NeRF 360, Barron et al. 2022, equation 10).
        """
        scale, shift = means.new_tensor(self._to_cube)
        places = means * scale + shift
        far = places.norm(dim=1, keepdim=True).clamp(min=1.0)
        contracted: Tensor = 0.5 * (2 - 1 / far) * (places / far)
        return contracted

    def check(self) -> None:
        """Raise ValueError unless the table and the network have the sizes of the options."""
        o = self.options
        hash_grid.check_table(self.levels, self.table, o.features)
        network.check_network(self.network, o.levels * o.features, 3)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Colour:
    """Return a field that is grey everywhere until it has been trained.

    Raises:
        UsageError: splats have harmonics of a higher degree, of which nothing would be drawn.
    """
    if splats.sh_degree:
        raise UsageError(
            f"the layer 'colour' takes the place of harmonics, but splats.sh_degree is "
            f"{splats.sh_degree}; set it to 0"
        )
    return Colour(options, facts, generator)
