"""Each picture has an exposure and a white balance of its own: an affine transform of its colours.

A splat of colour c is drawn in c + A c + b, with A (3, 3) and b (3) of the picture, or of each
fixed camera of a rig. Blending is linear, so that is what becomes of a picture where splats cover
it, and engines draw and compare it in one go. The mean over all is no change. A view that was not
trained on has what is linear in time between its neighbours on the path of its camera, or else
shows mean colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layer import Facts, Instant
from gsdmsr_cli.model.layers._views import PerView
from gsdmsr_cli.model.view_rows import Per
from gsdmsr_cli.options.strict import require, require_progress, require_rates
from gsdmsr_cli.scene.camera import Camera


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        per: what has a transform: each "frame", each fixed "camera", or "auto": cameras where a rig
            has at least two fixed ones with two pictures or more each, else frames.
        rate: learning rate of the 3 x 4 numbers at the start and the end.
        weight: of the mean over the transforms of their squared numbers, which holds them to 0.
        since: progress from which they are learnt.
    """

    per: Per = "auto"
    rate: tuple[float, float] = (1e-3, 1e-4)
    weight: float = 1e-3
    since: float = 0.0

    def __post_init__(self) -> None:
        require(self, "weight", self.weight >= 0, "0 or more")
        require_progress(self, "since")
        require_rates(self, "rate")


class Exposure(PerView):
    """Rows (3, 4): A and b, with all rows' mean taken away."""

    def as_seen(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment in the colours of its view."""
        values = self.values if self.learning else self.values.detach()
        own = self.weighed(values, instant.view, instant.time)
        if own is None:
            return moment
        change = own - self.values.detach().mean(dim=0)
        sh = _Changed.apply(moment.splats.sh, change)
        return replace(moment, splats=replace(moment.splats, sh=sh))

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return how views are drawn, of which kinds how many there are."""
        about = (
            "colours by an affine transform learnt from the train pictures; other views have what "
            "is linear in time between train views beside them on their path, or none"
        )
        return {"about": about, **super().tell_views(views)}

    def check(self) -> None:
        """Raise ValueError unless there is a transform for every view."""
        if self.values.shape[1:] != (3, 4):
            raise ValueError(f"transforms of colours of shape {tuple(self.values.shape)}")
        super().check()


class _Changed(Function):
    """Harmonics (N, K, 3) whose colours c become c + A c + b, by (3, 4) numbers A and b."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, change: Tensor) -> Tensor:
        ctx.save_for_backward(sh, change)
        turned = sh.reshape(-1, 3) @ change[:, :3].mT
        result = turned.view_as(sh).add_(sh)
        # colours are 1/2 + C0 sh[:, 0] + ...
        result[:, 0] += (change[:, :3].sum(dim=1) / 2 + change[:, 3]) / SH_C0
        return result

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_sh: Tensor) -> tuple[Tensor, Tensor]:
        sh, change = ctx.saved_tensors
        flat = d_sh.reshape(-1, 3)
        passed = (flat @ change[:, :3]).view_as(sh).add_(d_sh)
        # splats that are not finite are not drawn: their gradient is 0, and 0 times NaN is NaN
        by_axes = flat.mT @ sh.reshape(-1, 3).nan_to_num(0.0, 0.0, 0.0)
        by_shift = d_sh[:, 0].sum(dim=0)[:, None] / SH_C0
        return passed, torch.cat([by_axes + by_shift / 2, by_shift], dim=1)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Exposure:
    """Return transforms that change nothing until they have been trained."""
    o = options
    return Exposure(o.per, (3, 4), o.rate, o.weight, o.since, facts.bound)
