"""Learns which splats are worth keeping (Compact 3DGS, Lee et al., CVPR 2024, section 3.1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.strict import require

HIDDEN = -30.0
"""Logit of the opacity of a masked splat, which no engine draws."""

_MOST = 0.999
"""Opacity up to which the slope of the logit is taken."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        weight: of the mean of the masks; the paper has 5e-4 for real scenes, 4e-3 for synthetic.
        threshold: value of a mask at or below which its splat is not drawn, and is removed by the
            event ``masked``.
        rate: learning rate of the masks' logits, [start, end].
    """

    weight: float = 4e-3
    threshold: float = 0.01
    rate: tuple[float, float] = (0.01, 0.01)

    def __post_init__(self) -> None:
        require(self, "weight", self.weight >= 0, "0 or more")
        require(self, "threshold", 0 < self.threshold < 0.5, "above 0, below 0.5")
        require(self, "rate", min(self.rate) > 0, "[start, end], both above 0")


class Mask(Layer):
    """Scale and opacity times 1(m > threshold), m = sigmoid(logit), whose gradient is that of m."""

    concerns_still = True
    before_motion = True

    def __init__(self, options: Options, count: int) -> None:
        self.options = options
        self.logits = torch.ones(count)
        super().__init__([Parameter("logits", self.logits, per_splat=True, rate=options.rate)])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats, those that are masked with no opacity.

        The logarithm of a scale times M grows as M does at M = 1, the logit of an opacity o times
        M by 1 / (1 - o).
        """
        splats, kept = moment.splats, self.kept()
        m = self.logits.sigmoid()
        straight = m - m.detach()  # 0, with the gradient of m
        opacities = splats.logit_opacities.detach().sigmoid().clamp(max=_MOST)
        logits = splats.logit_opacities + straight / (1 - opacities)
        shown = torch.where(kept, logits, torch.full_like(logits, HIDDEN))
        scales = splats.log_scales + torch.where(kept, straight, 0.0)[:, None]
        return replace(moment, splats=replace(splats, logit_opacities=shown, log_scales=scales))

    def kept(self) -> Tensor:
        """Return which splats are drawn, (N,) bool."""
        threshold = self.options.threshold
        return self.logits.detach() > math.log(threshold / (1 - threshold))

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Return the weighted mean of the masks."""
        return self.options.weight * self.logits.sigmoid().mean()


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Mask:
    """Return masks that hide nothing."""
    return Mask(options, len(splats))
