"""Colours that change as splats turn, since the light does not turn with them.

Of a surface that hardly shines, the colour under light that stands still depends on its normal
alone, and smoothly so (Ramamoorthi & Hanrahan, SIGGRAPH 2001). The harmonics of a splat say how
its colour differs from side to side, not how it changes as an arm is raised. Here each splat has,
beside them, a linear function of its turn since the motion was given it: with the unit quaternion
(w, v) of the turn, w >= 0, the constant harmonic of each channel has 2 v . s added, with s of the
splat and the channel. Of small turns 2 v is the rotation vector.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.lighting import light
from gsdmsr_cli.options.strict import require_rates


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        rate: learning rate of the slopes at the start and the end.
    """

    rate: tuple[float, float] = (2.5e-3, 1e-3)

    def __post_init__(self) -> None:
        require_rates(self, "rate")


class Lighting(Layer):
    """Slopes (N, 3, 3): axis of the turn, channel."""

    needs_turns = True
    constants = ()

    def __init__(self, options: Options, count: int) -> None:
        self.slopes = torch.zeros(count, 3, 3)
        super().__init__([Parameter("slopes", self.slopes, True, options.rate)])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats in the colours that their turns give; turns have no gradient of it."""
        assert moment.canonical_quats is not None
        splats = moment.splats
        sh = light(splats.sh, self.slopes, splats.quats, moment.canonical_quats)
        return replace(moment, splats=replace(splats, sh=sh))

    def check(self) -> None:
        """Raise ValueError unless slopes are those of three axes and channels."""
        if self.slopes.shape[1:] != (3, 3):
            raise ValueError(f"slopes of shape {tuple(self.slopes.shape)}")


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Lighting:
    """Return a layer that changes nothing until it has been trained."""
    return Lighting(options, len(splats))
