"""GS-DMSR (Lu et al. 2026): a coarse explicit field plus a fine implicit decoder.

The coarse field moves positions only, through a linear decoder; the fine one moves positions,
rotations and scales through a network with a shared trunk, which also sees the coarse features
(the cross-scale pyramid). Both start as zero, so the motion starts as the identity.

Beyond the method, every splat has features of its own for the fine decoder (E-D3DGS, Bae et al.
2024): neighbours that part later need no grid fine enough to tell them apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.fields import network, planes
from gsdmsr_cli.fields.deformation import (
    OUTPUTS,
    displace,
    name_tensors,
    split_times,
    time_nodes,
    trained,
)
from gsdmsr_cli.motion import Facts
from gsdmsr_cli.splats import Splats

_EMBEDDINGS = "embeddings"

SMOOTH_ROWS = 1024
"""Splats that L_smooth looks at in a step."""


@dataclass(frozen=True)
class Options:
    """Settings of both fields and their regularisers.

    Attributes:
        coarse_level: spatial nodes of the coarse grid along an axis.
        coarse_channels: features of the coarse grid, a multiple of 16.
        coarse_time_ratio: the coarse grid's nodes in time per distinct train time.
        coarse_until: progress up to which only the coarse field moves splats (the method's N1).
        levels: spatial nodes of each level of the fine grid along an axis.
        channels: features per level of the fine grid, a multiple of 16.
        time_ratio: the fine grid's nodes in time per distinct train time.
        width: width of the decoder's two hidden layers, a multiple of 16.
        pyramid: give the coarse features to the fine decoder as well.
        embedding: features of its own that each splat has, a multiple of 16; 0 as in the method.
        embedding_weight: weight of the mean square of those features.
        detach: keep the fields' gradient from the canonical positions.
        offset_weight: weight of the mean squared coarse offset, in units of the bound.
        smooth_weight: weight of the mean squared difference of what the decoder says at a splat's
            place and beside it; 0 is off.
        smooth_reach: how far beside, as a standard deviation in units of the bound.
        space_smoothness, time_smoothness, time_stillness: weights of the plane regularisers.
    """

    coarse_level: int = 16
    coarse_channels: int = 16
    coarse_time_ratio: float = 0.125
    coarse_until: float = 0.06
    levels: tuple[int, ...] = (16, 32)
    channels: int = 16
    time_ratio: float = 0.2
    width: int = 32
    pyramid: bool = True
    embedding: int = 16
    embedding_weight: float = 0.0
    detach: bool = False
    offset_weight: float = 1e-3
    smooth_weight: float = 0.0
    smooth_reach: float = 0.005
    space_smoothness: float = 1e-4
    time_smoothness: float = 1e-2
    time_stillness: float = 1e-4


class MultiscaleMotion:
    """x + coarse + fine offset, q + fine offset, log s + fine offset (the method's section 3)."""

    def __init__(
        self, options: Options, facts: Facts, count: int, generator: torch.Generator
    ) -> None:
        self.options, self.facts = options, facts
        self.fine_active = False
        coarse_times = time_nodes(facts.frames, options.coarse_time_ratio)
        self.coarse = [
            trained(
                planes.new_level(
                    options.coarse_level, coarse_times, options.coarse_channels, generator
                )
            )
        ]
        self.coarse_decoder = [
            trained(layer) for layer in network.new_network([options.coarse_channels, 3], generator)
        ]
        times = time_nodes(facts.frames, options.time_ratio)
        self.fine = [
            trained(planes.new_level(resolution, times, options.channels, generator))
            for resolution in options.levels
        ]
        features = options.channels * len(options.levels) + options.embedding
        features += options.coarse_channels if options.pyramid else 0
        widths = [features, options.width, options.width, OUTPUTS]
        self.decoder = [trained(layer) for layer in network.new_network(widths, generator)]
        self.embeddings = torch.nn.Parameter(torch.zeros(count, options.embedding))

    def at(self, splats: Splats, time: float) -> Splats:
        """Return the deformed splats; time is mapped to the whole grids, [-1, 1]."""
        return self.at_times(splats, [time])[0]

    def at_times(self, splats: Splats, times: Sequence[float]) -> list[Splats]:
        """Return the deformed splats at several times.

        All grids are read in one go, the coarse one first: its decoder reads those columns only.
        """
        if not self.fine_active:
            features = self._features(self.coarse, splats, times)
            offsets = split_times(network.apply_network(self.coarse_decoder, features), len(times))
            return [replace(splats, means=splats.means + offset) for offset in offsets]
        features = self._features(self.coarse + self.fine, splats, times, self.embeddings)
        parts = [split_times(part, len(times)) for part in self._decode(features)]
        return [displace(splats, own, offset) for offset, own in zip(*parts, strict=True)]

    def _decode(self, features: Tensor) -> tuple[Tensor, ...]:
        """Return what both decoders make of the features of all grids, the coarse one's first."""
        if self.options.pyramid:
            return network.apply_networks([self.coarse_decoder, self.decoder], features)
        offset = network.apply_network(self.coarse_decoder, features)
        fine = features[:, self.options.coarse_channels :]
        return offset, network.apply_network(self.decoder, fine)

    def _features(
        self,
        levels: list[planes.Level],
        splats: Splats,
        times: Sequence[float],
        embeddings: Tensor | None = None,
    ) -> Tensor:
        points = splats.means.detach() if self.options.detach else splats.means
        moments = [2 * time - 1 for time in times]
        return planes.lookup_at_times(levels, points, moments, self.facts.box, embeddings)

    def take(self, rows: Tensor) -> None:
        """Resize the splats' own features."""
        self.embeddings = torch.nn.Parameter(self.embeddings.detach()[rows])

    def advance(self, progress: float) -> None:
        """Let the fine field join after ``coarse_until``."""
        self.fine_active = progress >= self.options.coarse_until

    def penalty(self, splats: Splats, time: float, generator: torch.Generator) -> Tensor | None:
        """Return the plane regularisers of the active grids, L_reg and L_smooth.

        And that of the splats' own features: what moves one splat unlike those around it was seen
        at few times from few sides, and the less of it there is, the better are other views met.
        """
        o = self.options
        levels = self.coarse + self.fine if self.fine_active else self.coarse
        value = planes.penalty(levels, o.space_smoothness, o.time_smoothness, o.time_stillness)
        if o.offset_weight > 0:
            features = self._features(self.coarse, splats, [time])
            offset = network.apply_network(self.coarse_decoder, features) / self.facts.bound
            value = value + o.offset_weight * offset.square().sum(dim=1).mean()
        if o.embedding and o.embedding_weight > 0 and self.fine_active:
            value = value + o.embedding_weight * self.embeddings.square().mean()
        if o.smooth_weight > 0 and self.fine_active:
            value = value + o.smooth_weight * self._roughness(splats, time, generator)
        return value

    def _roughness(self, splats: Splats, time: float, generator: torch.Generator) -> Tensor:
        """Return how much the decoder differs between places that are close to each other.

        A finite difference in place of the method's |grad_x phi|^2, at some of the splats.
        """
        rows = torch.randint(len(splats), (SMOOTH_ROWS,), generator=generator)
        rows = rows.to(splats.means.device)
        places = splats.means.detach()[rows]
        reach = self.options.smooth_reach * self.facts.bound
        beside = places + reach * torch.randn(places.shape, generator=generator).to(places)
        own = self.embeddings[rows].repeat(2, 1)
        both = replace(splats.take(rows.repeat(2)), means=torch.cat([places, beside]))
        features = self._features(self.coarse + self.fine, both, [time], own)
        here, there = self._decode(features)[1].chunk(2)
        return (here - there).square().sum(dim=1).mean()

    def tensors(self) -> dict[str, Tensor]:
        """Return both grids, both decoders and, if there are any, the splats' own features."""
        shared = name_tensors(
            {"coarse": self.coarse, "fine": self.fine},
            {"coarse_decoder": self.coarse_decoder, "decoder": self.decoder},
        )
        return shared | ({_EMBEDDINGS: self.embeddings} if self.options.embedding else {})

    def groups(self) -> dict[str, str]:
        """Return which learning rate each tensor follows."""
        return {name: _group(name) for name in self.tensors()}


def _group(name: str) -> str:
    if name == _EMBEDDINGS:
        return "embeddings"
    return "network" if "decoder" in name else "planes"


def start(
    options: Options, facts: Facts, count: int, generator: torch.Generator
) -> MultiscaleMotion:
    """Return a motion that is the identity until its decoders' last layers have learnt."""
    return MultiscaleMotion(options, facts, count, generator)
