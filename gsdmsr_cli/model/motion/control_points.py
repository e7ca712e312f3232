"""Sparse control points move, and every splat follows those near it (SC-GS, Huang et al. 2024).

In SC-GS a network of positional encodings gives the motion of the control points. Here a HexPlane
does (4D-GS, Wu et al. 2024), because it is trained within minutes.

A training has one view of each moment. A field that is evaluated at every splat can fit that view
in ways that are wrong from all other sides. A field that is evaluated at a thousand control points,
each of which moves its neighbourhood as a rigid body, has less freedom to do so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.motion._grids import name_parameters, time_nodes
from gsdmsr_cli.model.motion._limits import require_levels, require_multiples
from gsdmsr_cli.model.motion._rigidity import rigidity
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops import network, planes, skin, spread
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.ops.nearest import Nearest
from gsdmsr_cli.options import strict

_POINTS, _LOG_RADII = "control_points", "log_radii"

OPAQUE = 0.1
"""Control points are placed where splats of this opacity or more are."""

LEAST_SPACING = 1e-3
"""Least initial radius of a control point, in units of the bound."""


@dataclass(frozen=True)
class Options:
    """Settings of the control points, of their field and its regularisers.

    Attributes:
        count: number of control points, 4 or more.
        neighbours: how many of them each splat follows, at most ``count``.
        levels: resolution of each of the grid's 1 to 8 levels along a spatial axis.
        channels: features per level, a multiple of 16.
        time_ratio: the grid's resolution in time per distinct train time.
        width: width of the network's two hidden layers, a multiple of 16.
        space_smoothness, time_smoothness, time_stillness: weights of the plane regularisers.
        rigidity: weight of the control points' deviation from rigid motion.
    """

    count: int = 1024
    neighbours: int = 8
    levels: tuple[int, ...] = (16, 32)
    channels: int = 16
    time_ratio: float = 0.2
    width: int = 32
    space_smoothness: float = 1e-4
    time_smoothness: float = 1e-2
    time_stillness: float = 1e-4
    rigidity: float = 0.05

    def __post_init__(self) -> None:
        strict.require(self, "count", self.count > spread.SPACING_OF, "4 or more")
        within = 1 <= self.neighbours <= self.count
        strict.require(self, "neighbours", within, f"1 to count, which is {self.count}")
        require_levels(self, "levels")
        require_multiples(self, "channels", "width")


class ControlPointMotion(Layer):
    """Control points with radii, whose displacement, rotation and scaling a plane grid gives."""

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options, self.facts = options, facts
        lower, upper = torch.tensor(facts.box)
        anywhere = torch.rand(options.count, 3, generator=generator)
        self.control_points = spread.spread_out(lower + (upper - lower) * anywhere, options.count)
        self.log_radii = self._initial_log_radii(self.control_points)
        times = time_nodes(facts.frames, options.time_ratio)
        self.levels = [
            planes.new_level(resolution, times, options.channels, generator)
            for resolution in options.levels
        ]
        widths = [options.channels * len(options.levels), options.width, options.width, OUTPUTS]
        self.layers = network.new_network(widths, generator)
        self._search, self._pairs = Nearest(options.neighbours), Nearest(options.neighbours)
        self._near = torch.zeros(0, options.neighbours, dtype=torch.int32)
        self._found_for: Tensor | None = None
        super().__init__(
            [
                Parameter(_POINTS, self.control_points, rate="network"),
                Parameter(_LOG_RADII, self.log_radii, rate="network"),
                *name_parameters("grid", self.levels, "planes"),
                *name_parameters("network", self.layers, "network"),
            ]
        )

    def _initial_log_radii(self, points: Tensor) -> Tensor:
        """Return the logarithms of the radii (M,) that control points (M, 3) begin with."""
        return spread.spacing(points).clamp(min=LEAST_SPACING * self.facts.bound).log()

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved splats; times [0, 1] are mapped to the whole grid, [-1, 1]."""
        transforms = self._transforms(self.control_points, instant.time)
        near = self._neighbours(moment.splats.means)
        given = self.control_points, self.log_radii, transforms, near
        return replace(moment, splats=skin.skin(moment.splats, *given))

    def _transforms(self, points: Tensor, time: float) -> Tensor:
        features = planes.lookup(self.levels, points, 2 * time - 1, self.facts.box)
        return skin.transforms(points, network.apply_network(self.layers, features))

    def _neighbours(self, means: Tensor) -> Tensor:
        """Return which control points splats follow, (N, K) int32.

        The search is repeated whenever splats or control points may have changed: always in
        training, and once for all the moments at which a finished model is drawn.
        """
        if torch.is_grad_enabled() or not self._knows(means):
            self._near = self._search.find(means, self.control_points)
            # kept, so that no other splats get this memory
            self._found_for = None if torch.is_grad_enabled() else means.detach()
        return self._near

    def _knows(self, means: Tensor) -> bool:
        """Return whether the neighbours that were found last are those of these splats."""
        known = self._found_for
        return (
            known is not None and known.data_ptr() == means.data_ptr() and len(known) == len(means)
        )

    def reanchor(self, splats: Splats) -> Sequence[str]:
        """Spread the control points evenly over the present splats that are not transparent.

        The grid keeps its values, so the motion of splats hardly changes.
        """
        finite = splats.means.isfinite().all(dim=1)
        opaque = finite & (torch.sigmoid(splats.logit_opacities) >= OPAQUE)
        enough = int(opaque.sum()) >= len(self.control_points)
        places = splats.means[opaque if enough else finite]
        if not len(places):
            return ()
        points = spread.spread_out(places, len(self.control_points))
        self.control_points.copy_(points)
        self.log_radii.copy_(self._initial_log_radii(points))
        self._found_for = None
        return _POINTS, _LOG_RADII

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Drop the neighbours that were found; no parameter has a row per splat."""
        self._found_for = None

    def advance(self, progress: float) -> None:
        """Drop the neighbours that were found; there are no phases."""
        self._found_for = None

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Return the plane regularisers, and the rigidity of control points at a random time.

        The rigidity has gradients for the grid and the network, none for the control points.
        """
        o = self.options
        value = planes.penalty(self.levels, o.space_smoothness, o.time_smoothness, o.time_stillness)
        if not o.rigidity:
            return value
        points = self.control_points.detach()
        near = self._pairs.find(points, points)
        time = float(torch.rand((), generator=generator))
        transforms = self._transforms(points, time)
        return value + o.rigidity * rigidity(points, transforms, near)

    def check(self) -> None:
        """Raise ValueError unless control points, grid and network fit together."""
        shape, radii = tuple(self.control_points.shape), len(self.log_radii)
        if shape != (radii, 3) or radii <= spread.SPACING_OF:
            raise ValueError(f"{shape} control points, {radii} radii")
        if radii < self.options.neighbours:
            raise ValueError(f"{radii} control points for {self.options.neighbours} neighbours")
        planes.check_levels(self.levels)
        network.check_network(self.layers, planes.features_of(self.levels), OUTPUTS)
        self._found_for = None


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> ControlPointMotion:
    """Return a motion that is the identity until its network's last layer has been trained."""
    return ControlPointMotion(options, facts, generator)
