"""What exports that move share: a model's splats at any time, each in the same row at all times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from gsdmsr_cli.exports._source import Source, as_float32
from gsdmsr_cli.gaussians.fading import fade
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN
from gsdmsr_cli.moving.baking import bake
from gsdmsr_cli.moving.playing import UNSEEN, exponents_of, model_of

LEAST_TIMES = 16
"""At which a model is looked at, however few frames it was trained with: it moves between them."""

TOLERATED = {"colours": 2 / 255, "opacities": 2 / 255, "sizes": 0.02}
"""Changes up to these are not worth telling: of shares of white, opacities and log scales."""


@dataclass(frozen=True, eq=False)
class Moving:
    """N splats as they move, in the axes and units of the file.

    Attributes:
        source: of the model that plays what has been baked of the original one.
        lives: (N, 4) float32, as in ``moving.baked.Baked``; None where all are there always.
    """

    source: Source
    lives: Tensor | None

    def endless(self, time: float) -> Splats:
        """Return the splats at ``time`` in [0, 1], float32, as opaque as if there were no lives."""
        return as_float32(self.source.at(time))

    def at(self, time: float) -> Splats:
        """Return the splats at ``time`` in [0, 1], float32."""
        splats = self.endless(time)
        if self.lives is None:
            return splats
        logits = fade(splats.logit_opacities, exponents_of(self.lives, time))
        return replace(splats, logit_opacities=logits)

    def varying(self, times: Sequence[float], *names: str) -> list[str]:
        """Return which of these, as ``TOLERATED`` names them, change from time to time."""
        lowest: dict[str, Tensor] = {}
        highest: dict[str, Tensor] = {}
        for time in times:
            for name, values in _shares(self.at(time)).items():
                lowest[name] = torch.minimum(lowest.get(name, values), values)
                highest[name] = torch.maximum(highest.get(name, values), values)
        ranges = {name: (highest[name] - lowest[name]).flatten() for name in names}
        changed = [n for n, r in ranges.items() if bool((r > TOLERATED[n]).any())]
        return [f"{name} that change in time" for name in changed]


def _shares(splats: Splats) -> dict[str, Tensor]:
    opacities = splats.logit_opacities.sigmoid()
    return {"colours": SH_C0 * splats.sh, "opacities": opacities, "sizes": splats.log_scales}


def in_the_mean(moving: Moving, times: Sequence[float], splats: Splats) -> Splats:
    """Return splats with the opacities and colours that those that move have in the mean."""
    opacities, sh = torch.zeros_like(splats.logit_opacities), torch.zeros_like(splats.sh)
    for time in times:
        seen = moving.at(time)
        opacities += seen.logit_opacities.sigmoid() / len(times)
        sh += seen.sh / len(times)
    logits = opacities.clamp(UNSEEN, 1 - UNSEEN).logit()
    return replace(splats, logit_opacities=logits, sh=sh)


def evenly(count: int) -> list[float]:
    """Return so many times from 0 to 1, both included; 0 alone where there is one."""
    return [i / max(count - 1, 1) for i in range(count)]


@lru_cache(maxsize=1)  # once for what is lost, and once for the file
def moving(source: Source, frames: int) -> Moving:
    """Return the splats of a source as they move, without those that are never as opaque as asked.

    Args:
        source: whose model does not depend on the camera.
        frames: at how many times the model is looked at.

    Raises:
        DataError: a splat holds NaN or infinity.
    """
    least = max(source.asked.min_opacity, ALPHA_MIN)
    steps = max(frames - 1, 1)
    between = -(-(LEAST_TIMES - 1) // steps)  # so that what is looked at has the frames in it
    baked = bake(source.model, between * steps + 1, least)
    source.counts.append(len(baked.splats))
    lives = baked.lives
    if lives is not None:
        always = lives.new_tensor([0.0, 1.0, 0.0, 0.0])
        lives = torch.cat([lives, always.expand(len(baked.splats) - len(lives), 4)])
    asked = replace(source.asked, min_opacity=0.0)
    player = model_of(replace(baked, lives=None))
    return Moving(Source(player, asked, source.facts), lives)
