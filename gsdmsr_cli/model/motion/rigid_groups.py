"""Splats move in groups, each a rigid body with a position and a rotation per keyframe.

GroupFlow of SpeeDe3DGS (Tu et al., CVPR 2026, section 3.3). Moving splats then costs next to
nothing: no grid or network is asked. Groups are learnt from a motion that can do more, the base: it
is trained first, and the event ``distil`` lets groups take over. Without a base they are learnt
from the start, as neighbourhoods. Beyond the paper, a splat may do more than its group: it moves in
the group's frame, and grows, by the sum of a few series over time that all splats share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Following, Instant, options_of
from gsdmsr_cli.model.motion import _grouping as grouping
from gsdmsr_cli.model.motion._distilled import OWN, add_own, learn_groups, learn_series
from gsdmsr_cli.model.motion._grids import between, time_nodes
from gsdmsr_cli.model.motion._shared_series import sum_series
from gsdmsr_cli.model.motion._taking_over import PACKAGE, TakingOver
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops import skin
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.options.strict import require

OPAQUE = 0.1
"""Splats of this opacity or more may be anchors."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        count: number of groups; 2048 in the paper. Of a base there are never more than splats.
        series: number of series that splats have shares of beyond their group; 0, as in the paper,
            has none. They are learnt from the base.
        time_ratio: keyframes per distinct train time; 8 keyframes at least.
        smoothness: weight of the mean squared second difference of keyframes.
        rate: learning rate of keyframes and shares, at the start and at the end; with a higher one
            they learn the train views by heart.
        base: name and options of the motion that learns first, until the event ``distil``; null
            learns groups from the start.
    """

    count: int = 512
    series: int = 0
    time_ratio: float = 1.0
    smoothness: float = 0.0
    rate: tuple[float, float] = (1e-4, 1e-5)
    base: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        require(self, "count", self.count >= 1, "1 or more")
        require(self, "series", self.series >= 0, "0 or more")
        if self.base is None:
            require(self, "series", not self.series, "0, unless there is a base")
        require(self, "time_ratio", self.time_ratio > 0, "a number above 0")
        require(self, "smoothness", self.smoothness >= 0, "0 or more")
        require(self, "rate", min(self.rate) > 0, "[start, end], both above 0")
        if self.base is not None:
            name = self.base.get("name")
            another = isinstance(name, str) and f"{PACKAGE}.{name}" != __name__
            require(self, "base", another, "null or another motion's name and options")
            options_of(PACKAGE, self.base)


class RigidGroups(TakingOver):
    """x to R (x - p) + p + d, with R and d those of the splat's group, between two keyframes."""

    def __init__(
        self, options: Options, facts: Facts, splats: Splats, generator: torch.Generator
    ) -> None:
        self.options = options
        count, times = options.count, time_nodes(facts.frames, options.time_ratio)
        self.anchors, self.keys = torch.zeros(count, 3), torch.zeros(times, count, OUTPUTS)
        self.group = torch.zeros(len(splats), 1, dtype=torch.int32)
        self.series = torch.zeros(times, options.series)
        self.shares = torch.zeros(len(splats), options.series, OWN)
        own = [
            Parameter("anchors", self.anchors),
            Parameter("keys", self.keys, rate=options.rate),
            Parameter("group", self.group, per_splat=True),
        ]
        if options.series:
            own.append(Parameter("series", self.series))
            own.append(Parameter("shares", self.shares, per_splat=True, rate=options.rate))
        super().__init__(own, options.base, facts, splats, generator)
        if self.base is None:
            self._place(splats)

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return the moved splats at several times."""
        if not self.active:
            return super().at_instants(moment, instants)
        return [replace(moment, splats=self._moved(moment.splats, i.time)) for i in instants]

    def following(self) -> Following | None:
        """Return the groups, once they have taken over, unless splats do more than follow them."""
        if not self.active:
            return None if self.base is None else self.base.following()
        if self.options.series:
            return None
        group = self.group[:, 0].long()
        return Following(self.anchors, None, group, lambda time: between(self.keys, time))

    def _moved(self, splats: Splats, time: float) -> Splats:
        if self.options.series:
            splats = add_own(splats, sum_series(between(self.series, time), self.shares))
        transforms = skin.transforms(self.anchors, between(self.keys, time))
        radii = self.anchors.new_zeros(len(self.anchors))  # one point alone has all the weight
        return skin.skin(splats, self.anchors, radii, transforms, self.group)

    @torch.no_grad()
    def distil(self, splats: Splats) -> tuple[Splats, Sequence[str]]:
        """Group the splats by how the base moves them; each group moves as they do in the mean.

        The canonical splats become those of half time, moved to where they fit all times best.
        """
        base, o = self.base, self.options
        if base is None or self.active:
            return splats, ()

        def at(time: float) -> Splats:
            return base.at(Moment(splats), Instant(time)).splats.detach()

        groups = learn_groups(at, _opaque(splats), o.count, len(self.keys))
        learnt = {"anchors": groups.anchors, "keys": groups.keys, "group": groups.group[:, None]}
        settled = groups.splats
        if o.series:
            settled, learnt["series"], learnt["shares"] = learn_series(at, groups, o.series)
        for parameter in self._own:
            parameter.set_values(learnt[parameter.name].to(parameter.tensor.dtype))
        return settled, self.take_over(len(splats))

    @torch.no_grad()
    def _place(self, splats: Splats) -> None:
        """Spread the anchors over splats; each joins the group of the nearest."""
        rows = grouping.spread_rows(splats.means, _opaque(splats), len(self.anchors))
        self.anchors.copy_(splats.means[rows])
        self.group.copy_(grouping.group_paths(splats.means[None], rows, 1))

    def reanchor(self, splats: Splats) -> Sequence[str]:
        """Let the base adapt; without one, place groups as motion begins, but not after."""
        if not self.active:
            return super().reanchor(splats)
        if self.base is None and not self.keys.any():
            self._place(splats)
        return ()

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return the base's regularisers; once groups have taken over, how unsteady they are."""
        if not self.active:
            return super().penalty(moment, instant, generator)
        if not self.options.smoothness:
            return None
        bends = self.keys[2:] - 2 * self.keys[1:-1] + self.keys[:-2]
        return self.options.smoothness * bends.square().sum(dim=2).mean()

    def check(self) -> None:
        """Raise ValueError unless keyframes, anchors and groups fit together."""
        super().check()
        count, times = len(self.anchors), len(self.keys)
        if self.anchors.shape != (count, 3) or self.keys.shape != (times, count, OUTPUTS):
            shapes = tuple(self.anchors.shape), tuple(self.keys.shape)
            raise ValueError(f"anchors and keyframes of shapes {shapes}")
        if not count or times < 2:
            raise ValueError(f"{count} groups and {times} keyframes")
        if self.series.shape[0] != times or self.shares.shape[1:] != (self.series.shape[1], OWN):
            shapes = tuple(self.series.shape), tuple(self.shares.shape)
            raise ValueError(f"series and shares of shapes {shapes} for {times} keyframes")
        if self.group.shape[1] != 1 or ((self.group < 0) | (self.group >= count)).any():
            raise ValueError(f"splats of other groups than there are, {count}")


def _opaque(splats: Splats) -> Tensor:
    """Return the rows of the splats that may be anchors."""
    finite = splats.means.isfinite().all(dim=1)
    opaque = finite & (splats.logit_opacities.sigmoid() >= OPAQUE)
    rows = (opaque if opaque.any() else finite).nonzero().flatten()
    return rows if len(rows) else torch.arange(len(splats), device=rows.device)


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> RigidGroups:
    """Return groups that stay where they are until they are trained, or their base."""
    return RigidGroups(options, facts, splats, generator)
