"""A network moves sparse control points, and every splat follows those near it (SC-GS).

Huang et al., CVPR 2024, section 3: the network of Deformable-3DGS gives each control point a
displacement and a rotation; radii are learnt. In the first of two stages every splat is a control
point by itself, which the network displaces; then points are spread over these splats, which follow
them from now on. Neighbouring points move as rigidly as possible (section 3.3).

What differs from the paper: points have no features that neighbours are chosen by, nor weights
beside their radii; splats of the first stage are not isotropic, and go on in the second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import as_rigid_as_possible
from gsdmsr_cli.model.layer import Facts, Following, Instant
from gsdmsr_cli.model.limits import require_multiples
from gsdmsr_cli.model.motion._control_points import ControlPoints, require_points
from gsdmsr_cli.model.motion._encoded_network import MOST_OCTAVES, Shape, new_encoded_network
from gsdmsr_cli.ops.displace import PARTS
from gsdmsr_cli.options.strict import require, require_progress


@dataclass(frozen=True)
class Options:
    """Settings of the control points, of their network and of the regulariser.

    Attributes:
        count: number of control points, 4 or more.
        neighbours: how many of them each splat follows, at most ``count``.
        gather: how many times nearer to each other points are placed where splats move, 1 or more.
        alone_until: progress up to which every splat is a control point by itself.
        width: width of the hidden layers, a multiple of 16; 256 in the paper.
        depth: number of hidden layers, 2 to 16.
        position_octaves, time_octaves: frequencies of the encodings, 0 to 16.
        arap: weight of how far neighbouring points are from moving as rigidly as possible, at the
            start and at the end, log-linear in progress.
    """

    count: int = 512
    neighbours: int = 3
    gather: float = 1.0
    alone_until: float = 0.1
    width: int = 64
    depth: int = 8
    position_octaves: int = 10
    time_octaves: int = 6
    arap: tuple[float, float] = (1e-2, 1e-4)

    def __post_init__(self) -> None:
        require_points(self, self.count, self.neighbours, self.gather)
        require_progress(self, "alone_until")
        require_multiples(self, "width")
        require(self, "depth", 2 <= self.depth <= 16, "2 to 16")
        for key in ("position_octaves", "time_octaves"):
            within = 0 <= getattr(self, key) <= MOST_OCTAVES
            require(self, key, within, f"0 to {MOST_OCTAVES}")
        require(self, "arap", min(self.arap) > 0, "[start, end], both above 0")


class NetworkControlPoints(ControlPoints):
    """Control points whose displacement and rotation a network of positional encodings gives.

    Attributes:
        progress: of the training, by which stages and weights change.
    """

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        super().__init__(options.count, options.neighbours, options.gather, facts, generator)
        self.options, self.progress = options, 0.0
        sizes = options.width, options.depth, options.position_octaves, options.time_octaves
        self.network = new_encoded_network(Shape(*sizes), generator)
        self._parameters += (*self.network.parameters("network"),)

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved splats: displaced one by one, or taken along by control points."""
        if self.progress >= self.options.alone_until:
            return super().at(moment, instant)
        splats = moment.splats
        shift = self._deformation(splats.means, instant.time)[:, : PARTS[0]]
        return replace(moment, splats=replace(splats, means=splats.means + shift))

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return what ``at`` does at several times."""
        if self.progress >= self.options.alone_until:
            return super().at_instants(moment, instants)
        return [self.at(moment, instant) for instant in instants]

    def _deformations(self, points: Tensor, times: Sequence[float]) -> Tensor:
        """Return the network's outputs, without a gradient for the points by way of it."""
        outputs = self.network.apply(points.detach() / self.facts.bound, times)
        return outputs[0][None] if len(outputs) == 1 else torch.stack(outputs)

    def following(self) -> Following | None:
        """Return the control points, unless every splat is one by itself."""
        return super().following() if self.progress >= self.options.alone_until else None

    def advance(self, progress: float) -> None:
        """Enter the stage of ``progress``."""
        super().advance(progress)
        self.progress = progress

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Return how unlike rigid bodies points move between two random times, weighted.

        Of each point and its nearest others, the mean over pairs in units of their mean squared
        distance; the gradient is for the network alone.
        """
        points = self.control_points.detach()
        near = self._pairs.find(points, points).long()
        times = torch.rand(2, generator=generator).tolist()
        places = [points + self._deformation(points, t)[:, : PARTS[0]] for t in times]
        after, before = (goes[near] - goes[:, None] for goes in places)
        others = (near != torch.arange(len(near), device=near.device)[:, None]).to(points)
        off = as_rigid_as_possible(after, before, others)
        unit = (points[near] - points[:, None]).square().sum(dim=2)
        first, last = self.options.arap
        weight: float = first * (last / first) ** self.progress
        return weight * (off * others).sum() / unit.sum().clamp(min=torch.finfo(unit.dtype).tiny)

    def check(self) -> None:
        """Raise ValueError unless control points and network fit together."""
        super().check()
        self.network.check()


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> NetworkControlPoints:
    """Return a motion that is the identity until its network's last layer has been trained."""
    return NetworkControlPoints(options, facts, generator)
