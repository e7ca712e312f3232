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
from functools import partial

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.limits import require_multiples
from gsdmsr_cli.model.motion._decoder_smoothness import roughness, some_twice
from gsdmsr_cli.model.motion._grids import split_times, time_nodes
from gsdmsr_cli.model.motion._limits import require_degree, require_levels, require_resolutions
from gsdmsr_cli.model.parameter import Parameter, name_parameters
from gsdmsr_cli.ops import network, planes
from gsdmsr_cli.ops.displace import OUTPUTS, displace

_EMBEDDINGS = "embeddings"


@dataclass(frozen=True)
class Options:
    """Settings of both fields and their regularisers.

    Attributes:
        coarse_level: resolution of the coarse grid along a spatial axis.
        coarse_channels: features of the coarse grid, a multiple of 16.
        coarse_time_ratio: the coarse grid's resolution in time per distinct train time.
        coarse_until: progress up to which only the coarse field moves splats (the method's N1).
        levels: resolution of each of the fine grid's 1 to 7 levels along a spatial axis.
        channels: features per level of the fine grid, a multiple of 16.
        time_ratio: the fine grid's resolution in time per distinct train time.
        time_degree: of the B-splines between both grids' nodes in time, 1 (straight lines) or 3.
        width: width of the decoder's two hidden layers, a multiple of 16.
        pyramid: give the coarse features to the fine decoder as well.
        embedding: features of its own that each splat has, a multiple of 16; 0 as in the method.
        embedding_weight: weight of the mean square of those features.
        detach: keep the fields' gradient from the canonical positions.
        offset_weight: weight of the mean squared coarse offset, in units of the bound.
        smooth_weight: weight of the mean squared difference of the decoder's outputs at a
            splat and beside it; 0 is off.
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
    time_degree: int = 1
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

    def __post_init__(self) -> None:
        require_levels(self, "levels", besides=1)  # the coarse one
        require_degree(self, "time_degree")
        require_resolutions(self, "coarse_level")
        require_multiples(self, "channels", "coarse_channels", "width")
        require_multiples(self, "embedding", least=0)


class MultiscaleMotion(Layer):
    """x + coarse + fine offset, q + fine offset, log s + fine offset (the method's section 3)."""

    constants = ("fine_active",)

    def __init__(
        self, options: Options, facts: Facts, count: int, generator: torch.Generator
    ) -> None:
        self.options, self.facts = options, facts
        self.fine_active = False
        coarse_times = time_nodes(facts.frames, options.coarse_time_ratio)
        self.coarse = planes.new_levels(
            [options.coarse_level], coarse_times, options.coarse_channels, generator
        )
        self.coarse_decoder = network.new_network([options.coarse_channels, 3], generator)
        times = time_nodes(facts.frames, options.time_ratio)
        self.fine = planes.new_levels(options.levels, times, options.channels, generator)
        features = options.channels * len(options.levels) + options.embedding
        features += options.coarse_channels if options.pyramid else 0
        self.decoder = network.new_network([features, *[options.width] * 2, OUTPUTS], generator)
        self.embeddings = torch.zeros(count, options.embedding) if options.embedding else None
        super().__init__(self._named())

    def _named(self) -> list[Parameter]:
        along_time = partial(
            name_parameters,
            rate="planes",
            time_axes=planes.TIME_AXES,
            time_degree=self.options.time_degree,
        )
        parameters = (
            along_time("coarse", self.coarse)
            + along_time("fine", self.fine)
            + name_parameters("coarse_decoder", self.coarse_decoder, "network")
            + name_parameters("decoder", self.decoder, "network")
        )
        if self.embeddings is not None:
            parameters.append(Parameter(_EMBEDDINGS, self.embeddings, True, "embeddings"))
        return parameters

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the deformed splats; time is mapped to the whole grids, [-1, 1]."""
        return self.at_instants(moment, [instant])[0]

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return the deformed splats at several times.

        All grids are read in one go, the coarse one first: its decoder reads those columns only.
        """
        splats, count = moment.splats, len(instants)
        if not self.fine_active:
            features = self._features(self.coarse, splats, instants)
            offsets = split_times(network.apply_network(self.coarse_decoder, features), count)
            moved = [replace(splats, means=splats.means + offset) for offset in offsets]
        else:
            features = self._features(self.coarse + self.fine, splats, instants, self.embeddings)
            parts = [split_times(part, count) for part in self._decode(features)]
            moved = [displace(splats, own, offset) for offset, own in zip(*parts, strict=True)]
        return [replace(moment, splats=own) for own in moved]

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
        instants: Sequence[Instant],
        embeddings: Tensor | None = None,
    ) -> Tensor:
        points = splats.means.detach() if self.options.detach else splats.means
        given = levels, points, [now.time for now in instants], self.facts.box, embeddings
        return planes.lookup_at_times(*given, planes.evenly, self.options.time_degree)

    def advance(self, progress: float) -> None:
        """Let the fine field join after ``coarse_until``."""
        self.fine_active = progress >= self.options.coarse_until

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Return the regularisers of the active grids, L_reg, L_smooth and that of embeddings.

        Embeddings let one splat move unlike those around it, which few views show: the smaller
        they are, the better are unseen views.
        """
        o = self.options
        levels = self.coarse + self.fine if self.fine_active else self.coarse
        value = planes.penalty(levels, o.space_smoothness, o.time_smoothness, o.time_stillness)
        if o.offset_weight > 0:
            features = self._features(self.coarse, moment.splats, [instant])
            offset = network.apply_network(self.coarse_decoder, features) / self.facts.bound
            value = value + o.offset_weight * offset.square().sum(dim=1).mean()
        if self.embeddings is not None and o.embedding_weight > 0 and self.fine_active:
            value = value + o.embedding_weight * self.embeddings.square().mean()
        if o.smooth_weight > 0 and self.fine_active:
            reach = o.smooth_reach * self.facts.bound
            some = some_twice(moment.splats, self.embeddings, reach, generator)
            value = value + o.smooth_weight * roughness(self._fine_outputs(*some, instant))
        return value

    def _fine_outputs(self, splats: Splats, embeddings: Tensor | None, instant: Instant) -> Tensor:
        """Return what the fine decoder says of splats that have such features of their own."""
        features = self._features(self.coarse + self.fine, splats, [instant], embeddings)
        return self._decode(features)[1]

    def check(self) -> None:
        """Raise ValueError unless grids, decoders and features of their own fit together."""
        planes.check_levels([*self.coarse, *self.fine])
        coarse, fine = planes.features_of(self.coarse), planes.features_of(self.fine)
        network.check_network(self.coarse_decoder, coarse, 3)
        own = 0 if self.embeddings is None else self.embeddings.shape[1]
        network.check_network(self.decoder, fine + coarse * self.options.pyramid + own, OUTPUTS)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> MultiscaleMotion:
    """Return a motion that is the identity until its decoders' last layers have been trained."""
    return MultiscaleMotion(options, facts, len(splats), generator)
