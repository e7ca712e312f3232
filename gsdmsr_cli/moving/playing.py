"""Plays what has been baked: a model like any other, which is drawn and not trained."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.fading import fade
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.model.times import inverse_durations
from gsdmsr_cli.moving.baked import COLOURS, OF_BODIES, Baked, Bodies
from gsdmsr_cli.ops import skin
from gsdmsr_cli.ops.nearest import nearest_points

UNSEEN = 1e-6
"""Opacities count as this much at least, and as 1 less it at most: their logits are finite."""


class Played(Layer):
    """Splats that follow bodies, and their own curves, and are there for their lives."""

    identity_at_start = False

    def __init__(self, baked: Baked) -> None:
        self._bodies, self._tracks, self._lives = baked.bodies, baked.tracks, baked.lives
        self._near: Tensor | None = None
        if baked.bodies is not None:
            self._near = _near(baked.bodies, baked.splats.means[: baked.moving])
        held = {name: track.shares for name, track in baked.tracks.items()}
        held |= {f"curves/{name}": track.curves for name, track in baked.tracks.items()}
        super().__init__([Parameter(name, tensor) for name, tensor in held.items()])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved splats."""
        splats = self._followed(moment.splats, instant.time)
        splats = self._changed(splats, instant.time)
        return replace(moment, splats=self._faded(splats, instant.time))

    def _followed(self, splats: Splats, time: float) -> Splats:
        """Return the splats where bodies take them."""
        bodies = self._bodies
        if bodies is None or self._near is None:
            return splats
        parts = [
            self._tracks[name].at(time) if name in self._tracks else splats.means.new_zeros(1, 1)
            for name in OF_BODIES
        ]
        count = len(bodies.points)
        whole = [
            part.expand(count, channels)
            for part, channels in zip(parts, OF_BODIES.values(), strict=True)
        ]
        transforms = skin.transforms(bodies.points, torch.cat(whole, dim=1))
        radii = bodies.points.new_zeros(count) if bodies.log_radii is None else bodies.log_radii
        return skin.skin(splats, bodies.points, radii, transforms, self._near)

    def _changed(self, splats: Splats, time: float) -> Splats:
        """Return the splats with what their own curves add."""

        def plus(value: Tensor, name: str) -> Tensor:
            track = self._tracks.get(name)
            return value if track is None else value + track.at(time).view_as(value)

        logits = splats.logit_opacities
        if "splat/opacity" in self._tracks:
            logits = plus(logits.sigmoid(), "splat/opacity").clamp(UNSEEN, 1 - UNSEEN).logit()
        return Splats(
            plus(splats.means, "splat/offset"),
            plus(splats.quats, "splat/turn"),
            plus(splats.log_scales, "splat/growth"),
            logits,
            plus(splats.sh, COLOURS),
        )

    def _faded(self, splats: Splats, time: float) -> Splats:
        """Return the splats as opaque as they are at this time of their lives."""
        if self._lives is None:
            return splats
        exponents = exponents_of(self._lives, time)
        return replace(splats, logit_opacities=fade(splats.logit_opacities, exponents))


def exponents_of(lives: Tensor, time: float) -> Tensor:
    """Return e (M,), where exp(-e) is how much of its opacity a splat has at a time."""
    first, last, appearing, vanishing = lives.unbind(1)
    early = (first - time).relu() * inverse_durations(appearing)
    late = (time - last).relu() * inverse_durations(vanishing)
    return early.square() + late.square()


def model_of(baked: Baked) -> Model:
    """Return the model that plays what has been baked."""
    model = Model(baked.splats, {MOTION: Played(baked)}, baked.moving)
    for tensor in model.tensors().values():
        tensor.requires_grad_(False)
    return model


def _near(bodies: Bodies, means: Tensor) -> Tensor:
    """Return which bodies splats follow, (M, K) int32."""
    if bodies.body is not None:
        return bodies.body.to(torch.int32)[:, None].contiguous()
    near = torch.zeros(len(means), bodies.neighbours, dtype=torch.int32, device=means.device)
    return nearest_points(means, bodies.points, near)
