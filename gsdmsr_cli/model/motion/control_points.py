"""Sparse control points move, and every splat follows those near it (SC-GS, Huang et al. 2024).

In SC-GS a network of positional encodings gives the motion of the control points. Here a HexPlane
does (4D-GS, Wu et al. 2024), because it is trained within minutes.

A training has one view of each moment. A field that is evaluated at every splat can fit that view
in ways that are wrong from all other sides. A field that is evaluated at a thousand control points,
each of which moves its neighbourhood as a rigid body, has less freedom to do so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant
from gsdmsr_cli.model.limits import require_multiples
from gsdmsr_cli.model.motion._control_points import ControlPoints, require_points
from gsdmsr_cli.model.motion._grids import sparser_at_ends, time_nodes
from gsdmsr_cli.model.motion._limits import require_degree, require_levels
from gsdmsr_cli.model.motion._rigidity import rigidity
from gsdmsr_cli.model.motion._time_offsets import Clock, TimeOffsets
from gsdmsr_cli.model.parameter import name_parameters
from gsdmsr_cli.ops import network, planes, skin
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.options.strict import require, require_at_least, require_progress
from gsdmsr_cli.scene.camera import Camera


@dataclass(frozen=True)
class Options:
    """Settings of the control points, of their field and its regularisers.

    Attributes:
        count: number of control points, 4 or more.
        neighbours: how many of them each splat follows, at most ``count``.
        gather: how many times nearer to each other points are placed where splats move, 1 or more.
        levels: resolution of each of the grid's 1 to 8 levels along a spatial axis.
        channels: features per level, a multiple of 16.
        time_ratio: the grid's resolution in time per distinct train time.
        time_ends: density of the grid's nodes at the first and the last time, in units of that of
            an even grid: above 0, at most 1.
        time_degree: of the B-splines between them, 1 (straight lines) or 3 (cubic curves, whose
            velocity and acceleration do not jump).
        time_offsets_from: progress from which on it is learnt when each frame was taken, beside
            what it says; 1 for never.
        time_offsets_weight: weight of the mean square of these offsets [1 / frame^2].
        width: width of the network's two hidden layers, a multiple of 16.
        space_smoothness, time_smoothness, time_stillness: weights of the plane regularisers.
        rigidity: weight of the control points' deviation from rigid motion.
        rigidity_until: progress at which that weight has fallen to 0, evenly from half of it on; 0
            keeps the weight.
    """

    count: int = 1024
    neighbours: int = 8
    gather: float = 1.0
    levels: tuple[int, ...] = (16, 32)
    channels: int = 16
    time_ratio: float = 0.2
    time_ends: float = 1.0
    time_degree: int = 1
    time_offsets_from: float = 1.0
    time_offsets_weight: float = 1e-4
    width: int = 32
    space_smoothness: float = 1e-4
    time_smoothness: float = 1e-2
    time_stillness: float = 1e-4
    rigidity: float = 0.05
    rigidity_until: float = 0.0

    def __post_init__(self) -> None:
        require_points(self, self.count, self.neighbours, self.gather)
        require_levels(self, "levels")
        require_multiples(self, "channels", "width")
        require(self, "time_ends", 0 < self.time_ends <= 1, "above 0, at most 1")
        require_degree(self, "time_degree")
        require_progress(self, "time_offsets_from")
        require_at_least(self, 0, "time_offsets_weight")
        require_progress(self, "rigidity_until")


class ControlPointMotion(ControlPoints):
    """Control points with radii, whose displacement, rotation and scaling a plane grid gives.

    Attributes:
        follows_offsets: whether frames are shown at the times that they were taken at, as far as
            these have been learnt.
    """

    constants = ("follows_offsets",)

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        super().__init__(options.count, options.neighbours, options.gather, facts, generator)
        self.options = options
        self._rigidity = options.rigidity
        times = time_nodes(facts.frames, options.time_ratio)
        self._offsets: TimeOffsets | None = None
        if options.time_offsets_from < 1 and facts.frames > 1:
            self._offsets = TimeOffsets(facts.frames)
        self.follows_offsets = True
        self._denser = sparser_at_ends(options.time_ends)
        self.levels = planes.new_levels(options.levels, times, options.channels, generator)
        widths = [options.channels * len(options.levels), options.width, options.width, OUTPUTS]
        self.layers = network.new_network(widths, generator)
        self._parameters += (
            *name_parameters(
                "grid", self.levels, "planes", planes.TIME_AXES, self._place, options.time_degree
            ),
            *name_parameters("network", self.layers, "network"),
        )
        if self._offsets is not None:
            self._parameters += (*self._offsets.parameters("time_offsets"),)

    def advance(self, progress: float) -> None:
        """Enter the phase of training that belongs to ``progress`` in [0, 1]."""
        super().advance(progress)
        o = self.options
        self.follows_offsets = progress >= o.time_offsets_from
        if self._offsets is not None and self.follows_offsets:
            self._offsets.advance(progress)
        if o.rigidity_until:
            left = 2 * (1 - progress / o.rigidity_until)
            self._rigidity = o.rigidity * min(max(left, 0.0), 1.0)

    def _deformations(self, points: Tensor, times: Sequence[float]) -> Tensor:
        """Return the outputs for points when the frames of these times were taken."""
        if self._offsets is None or not self.follows_offsets:
            return self._outputs(points, times, planes.as_given)
        return self._offsets.follow(lambda clock: self._outputs(points, times, clock), times)

    def _outputs(self, points: Tensor, times: Sequence[float], clock: Clock) -> Tensor:
        """Return the outputs for points at the times to which a clock takes ``times``.

        The times from 0 to 1 are mapped to the whole grid, [-1, 1].
        """

        def on_grid(time: float) -> float:
            return planes.evenly(self._place(clock(time)))

        given = self.levels, points, times, self.facts.box
        features = planes.lookup_at_times(*given, place=on_grid, degree=self.options.time_degree)
        outputs = network.apply_network(self.layers, features)
        return outputs.view(len(times), len(points), OUTPUTS)

    def _place(self, time: float) -> float:
        """Return where in [0, 1] a time lies along the grid's axis of time."""
        return self._denser(time if self._offsets is None else self._offsets.inside(time))

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Return the regularisers of planes and offsets, and the rigidity at a random time.

        The rigidity has gradients for the grid and the network, none for the control points.
        """
        o = self.options
        value = planes.penalty(self.levels, o.space_smoothness, o.time_smoothness, o.time_stillness)
        if self._offsets is not None and self.follows_offsets:
            value = value + o.time_offsets_weight * self._offsets.values.square().mean()
        if not self._rigidity:
            return value
        points = self.control_points.detach()
        near = self._pairs.find(points, points)
        time = float(torch.rand((), generator=generator))
        transforms = skin.transforms(points, self._outputs(points, [time], planes.as_given)[0])
        return value + self._rigidity * rigidity(points, transforms, near)

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return by how many frames later than they say views are shown."""
        if self._offsets is None:
            return {}
        about = "shown at the times at which train pictures, it was learnt, had been taken"
        return {"about": about, "time_offsets": self._offsets.of([time for _, time in views])}

    def check(self) -> None:
        """Raise ValueError unless control points, grid, network and offsets fit together."""
        super().check()
        if self._offsets is not None:
            self._offsets.check(self.facts.frames)
        planes.check_levels(self.levels)
        network.check_network(self.layers, planes.features_of(self.levels), OUTPUTS)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> ControlPointMotion:
    """Return a motion that is the identity until its network's last layer has been trained."""
    return ControlPointMotion(options, facts, generator)
