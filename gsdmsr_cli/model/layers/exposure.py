"""Each picture has an exposure and a white balance of its own: an affine transform of its colours.

What has been drawn becomes c + (A c + b) alpha, with A (3, 3) and b (3) of the picture, or of each
fixed camera of a rig. The mean over all is no change. A view that was not trained on has what is
linear in time between its neighbours on the path of its camera, or else shows mean colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.splats import Splats
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

    shades = True

    def shade(self, frame: Frame, instant: Instant) -> Frame:
        """Return the frame in the colours of its view."""
        values = self.values if self.learning else self.values.detach()
        own = self.weighed(values, instant.view, instant.time)
        if own is None:
            return frame
        change = own - self.values.detach().mean(dim=0)
        planes = frame.rgb.permute(2, 0, 1).flatten(1)
        added = torch.addmm(change[:, 3:], change[:, :3], planes) * frame.alpha.reshape(1, -1)
        height, width, _ = frame.rgb.shape
        rgb = (planes + added).view(3, height, width).permute(1, 2, 0)
        return replace(frame, rgb=rgb)

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


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Exposure:
    """Return transforms that change nothing until they have been trained."""
    o = options
    return Exposure(o.per, (3, 4), o.rate, o.weight, o.since, facts.bound)
