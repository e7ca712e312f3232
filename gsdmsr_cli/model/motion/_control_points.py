"""What motions share whose splats follow control points: their places, radii and neighbours.

SC-GS (Huang et al., CVPR 2024). How the points themselves move is the motion's own.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Following, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops import skin, spread
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.nearest import Nearest
from gsdmsr_cli.options import strict

_POINTS, _LOG_RADII = "control_points", "log_radii"

OPAQUE = 0.1
"""Control points are placed where splats of this opacity or more are."""

LEAST_SPACING = 1e-3
"""Least initial radius of a control point, in units of the bound."""

_INSTANTS = 8
"""Times, evenly spaced, at which it is looked where splats go."""


def require_points(options: object, count: int, neighbours: int, gather: float) -> None:
    """Check how many control points there are, how many a splat follows, and where they are.

    Raises:
        InvalidError: there are too few of either, a splat follows more than there are, or
            ``gather`` is below 1.
    """
    strict.require(options, "count", count > spread.SPACING_OF, "4 or more")
    within = 1 <= neighbours <= count
    strict.require(options, "neighbours", within, f"1 to count, which is {count}")
    strict.require(options, "gather", gather >= 1, "1 or more")


class ControlPoints(Layer):
    """Control points with radii, whose displacement, rotation and scaling a subclass gives.

    Args:
        count: number of control points.
        neighbours: how many of them each splat follows.
        gather: how many times nearer to each other points are placed where splats move.
        facts, generator: see ``start_layer``.
    """

    def __init__(
        self, count: int, neighbours: int, gather: float, facts: Facts, generator: torch.Generator
    ) -> None:
        self.facts, self._kept, self._gather = facts, neighbours, gather
        lower, upper = torch.tensor(facts.box)
        anywhere = torch.rand(count, 3, generator=generator)
        self.control_points = spread.spread_out(lower + (upper - lower) * anywhere, count)
        self.log_radii = self._initial_log_radii(self.control_points)
        self._search, self._pairs = Nearest(neighbours), Nearest(neighbours)
        self._near = torch.zeros(0, neighbours, dtype=torch.int32)
        self._found_for: Tensor | None = None
        super().__init__(
            [
                Parameter(_POINTS, self.control_points, rate="network"),
                Parameter(_LOG_RADII, self.log_radii, rate="network"),
            ]
        )

    def _initial_log_radii(self, points: Tensor) -> Tensor:
        """Return the logarithms of the radii (M,) that control points (M, 3) begin with."""
        return spread.spacing(points).clamp(min=LEAST_SPACING * self.facts.bound).log()

    @abstractmethod
    def _deformations(self, points: Tensor, times: Sequence[float]) -> Tensor:
        """Return (T, M, 10) of points (M, 3) at times in [0, 1], see ``ops.skin.transforms``."""

    def _deformation(self, points: Tensor, time: float) -> Tensor:
        """Return (M, 10) of points (M, 3) at a time."""
        return self._deformations(points, [time])[0]

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved splats."""
        given = self._followed(moment, self._deformation(self.control_points, instant.time))
        return replace(moment, splats=skin.skin(moment.splats, *given))

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return the moved splats at several times.

        A GPU gets them by the launches of one time, since it mostly waits for the next launch.
        On a CPU there is nothing to gain by it.
        """
        if len(instants) == 1 or choose(self.control_points) != "cuda":
            return super().at_instants(moment, instants)
        times = [instant.time for instant in instants]
        given = self._followed(moment, self._deformations(self.control_points, times))
        moved = skin.skin_at_times(moment.splats, *given)
        return [replace(moment, splats=splats) for splats in moved]

    def _followed(self, moment: Moment, deformations: Tensor) -> tuple[Tensor, ...]:
        """Return points, radii and transforms at these deformations, and whom splats follow."""
        transforms = skin.transforms(self.control_points, deformations)
        near = self._neighbours(moment.splats.means)
        return self.control_points, self.log_radii, transforms, near

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

    def following(self) -> Following | None:
        """Return the control points, and how they move."""

        def movement(time: float) -> Tensor:
            return self._deformation(self.control_points, time)

        return Following(self.control_points, self.log_radii, self._kept, movement)

    def reanchor(self, splats: Splats) -> Sequence[str]:
        """Spread the control points over the present splats that are not transparent.

        Evenly, unless there are more where splats move. What moves the points keeps its values, so
        the motion of splats hardly changes.
        """
        finite = splats.means.isfinite().all(dim=1)
        opaque = finite & (torch.sigmoid(splats.logit_opacities) >= OPAQUE)
        enough = int(opaque.sum()) >= len(self.control_points)
        rows = (opaque if enough else finite).nonzero()[:, 0]
        if not len(rows):
            return ()
        weights = None if self._gather == 1 else self._weights(splats.take(rows))
        points = spread.spread_out(splats.means[rows], len(self.control_points), weights)
        self.control_points.copy_(points)
        self.log_radii.copy_(self._initial_log_radii(points))
        self._found_for = None
        return _POINTS, _LOG_RADII

    @torch.no_grad()
    def _weights(self, splats: Splats) -> Tensor:
        """Return how densely control points are to lie at splats, from 1 to ``gather``, (N,).

        As densely as can be where a splat goes farther from its mean place than points that are
        spread evenly lie apart, and the less the less far it goes.
        """
        moment, spans = Moment(splats), (i / (_INSTANTS - 1) for i in range(_INSTANTS))
        ways = torch.stack([self.at(moment, Instant(t)).splats.means for t in spans])
        farthest = (ways - ways.mean(dim=0)).norm(dim=2).amax(dim=0)
        even = spread.spread_out(splats.means, len(self.control_points))
        apart = self._initial_log_radii(even).exp().square().mean().sqrt()
        shares: Tensor = (farthest / apart.to(farthest)).clamp(max=1)
        return 1 + (self._gather - 1) * shares

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Drop the neighbours that were found; no parameter has a row per splat."""
        self._found_for = None

    def advance(self, progress: float) -> None:
        """Drop the neighbours that were found; there are no phases."""
        self._found_for = None

    def check(self) -> None:
        """Raise ValueError unless control points and radii fit together."""
        shape, radii = tuple(self.control_points.shape), len(self.log_radii)
        if shape != (radii, 3) or radii <= spread.SPACING_OF:
            raise ValueError(f"{shape} control points, {radii} radii")
        if radii < self._kept:
            raise ValueError(f"{radii} control points for {self._kept} neighbours")
        self._found_for = None
