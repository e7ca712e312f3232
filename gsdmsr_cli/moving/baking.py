"""Bakes a model: looks at it at many times, and finds the curves that its splats share.

No layer has to know of this. One whose splats follow bodies, or live for a while, may say so
(``Layer.following``, ``Layer.lives``), which takes fewer bytes. The rest is in the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats, together
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN
from gsdmsr_cli.model.layer import Following, Instant
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.moving.baked import COLOURS, OF_BODIES, Baked, Bodies
from gsdmsr_cli.moving.curves import Track, track_of
from gsdmsr_cli.moving.looking import (
    Samples,
    add,
    at,
    in_the_mean,
    look,
    stacked,
    without_lives,
)
from gsdmsr_cli.moving.playing import Played
from gsdmsr_cli.moving.shapes import upright

MOST_TIMES = 256
"""At which a model is looked at; more of them are hardly ever seen apart."""

NOTHING = 1e-6
"""Tracks that nowhere differ by more from nothing are rounding."""


@torch.no_grad()
def bake(model: Model, frames: int, least_opacity: float = ALPHA_MIN) -> Baked:
    """Return a model's splats and how they move; those that are never seen are left out.

    Args:
        model: on a CPU; its splats do not depend on the camera. Features and ``shade`` are not
            baked.
        frames: number of distinct times at which it has been trained.
        least_opacity: splats that are never as opaque are never seen.

    Raises:
        DataError: a splat holds NaN or infinity.
    """
    model = model.steadied()
    moving = _moving(model)
    count = min(max(frames, 2), MOST_TIMES) if moving else 1
    times = [i / max(count - 1, 1) for i in range(count)]
    lives, following = _lives(model, moving), _following(model)
    samples, still = look(model, times, moving)
    samples = without_lives(samples, lives, times)
    splats = _canonical(model, moving) if following is not None else in_the_mean(samples)
    splats = together([splats, still])
    _require_finite(splats, samples)
    quats, turns = upright(splats.quats)
    splats = replace(splats, quats=quats)
    turned = samples["quats"]
    turned = quat_product(turned, turns[:moving].expand_as(turned))
    samples = {**samples, "quats": turned}
    bodies, tracks = _bodies(following, times)
    baked = Baked(splats, moving, count, bodies, tracks)
    own = _own_tracks(baked, samples, times)
    opacities = samples["opacities"].amax(dim=0)[:, 0]
    baked = replace(baked, tracks={**tracks, **own}, lives=lives)
    return _only_seen(baked, opacities, least_opacity)


def _moving(model: Model) -> int:
    """Return how many splats change in time: all if any of those that stand still does."""
    first, last = (at(model, time).detach() for time in (0.0, 1.0))
    same = all(
        torch.equal(one[model.moving :], other[model.moving :])
        for one, other in zip(first.tensors().values(), last.tensors().values(), strict=True)
    )
    return model.moving if same else len(model.splats)


def _lives(model: Model, moving: int) -> Tensor | None:
    """Return the lives that a layer knows of; what further ones do is in the samples."""
    given = _canonical(model, moving)
    for layer in model.layers.values():
        lives = None if layer.before_motion else layer.lives(given)
        if lives is not None and len(lives) == moving:
            return lives
    return None


def _following(model: Model) -> Following | None:
    return model.layers[MOTION].following() if MOTION in model.layers else None


def _canonical(model: Model, moving: int) -> Splats:
    """Return the splats that move as the motion is given them."""
    splats = model.canonical().splats.detach()
    return splats.map(lambda tensor: tensor[:moving])


def _require_finite(splats: Splats, samples: Samples) -> None:
    """Raise DataError unless all values are finite."""
    values = [*splats.tensors().values(), *samples.values()]
    if not all(bool(tensor.isfinite().all()) for tensor in values):
        raise DataError(
            "splats hold NaN or infinite values; nothing is written: export an earlier checkpoint "
            "or train again"
        )


def _bodies(
    following: Following | None, times: Sequence[float]
) -> tuple[Bodies | None, dict[str, Track]]:
    """Return what splats follow, and how it moves."""
    if following is None:
        return None, {}
    movements = torch.stack([following.movement(time) for time in times], dim=2)
    offset, turn, growth = movements.split(list(OF_BODIES.values()), dim=1)
    nothing = torch.zeros_like(turn)
    nothing[:, 0] = 1
    turn = torch.nn.functional.normalize(turn + nothing, dim=1) - nothing
    parts = zip(OF_BODIES, (offset, turn, growth), strict=True)
    tracks = {name: track_of(part) for name, part in parts if part.abs().max() > NOTHING}
    near, radii = following.near, following.log_radii
    body, neighbours = (None, near) if isinstance(near, int) else (near, 0)
    return Bodies(following.points, radii, body, neighbours), tracks


def _own_tracks(baked: Baked, samples: Samples, times: Sequence[float]) -> dict[str, Track]:
    """Return what splats do beside following bodies."""
    if not baked.moving:
        return {}
    played = Played(baked)
    canonical = Moment(baked.splats.map(lambda tensor: tensor[: baked.moving]))
    differences: dict[str, list[Tensor]] = {}
    for place, time in enumerate(times):
        splats = played.at(canonical, Instant(time)).splats
        length = splats.quats.norm(dim=1, keepdim=True)
        seen = {name: tensor[place] for name, tensor in samples.items()}
        turned = seen["quats"]
        turned = torch.where((turned * splats.quats).sum(dim=1, keepdim=True) < 0, -turned, turned)
        apart = {
            "splat/offset": seen["means"] - splats.means,
            "splat/turn": turned * length - splats.quats,
            "splat/growth": seen["log_scales"] - splats.log_scales,
            "splat/opacity": seen["opacities"] - splats.logit_opacities.sigmoid()[:, None],
            COLOURS: seen["sh"] - splats.sh.flatten(1),
        }
        for name, tensor in apart.items():
            add(differences.setdefault(name, []), tensor)
    whole = {name: stacked(tensors).permute(1, 2, 0) for name, tensors in differences.items()}
    return {name: track_of(t) for name, t in whole.items() if t.abs().max() > NOTHING}


def _only_seen(baked: Baked, opacities: Tensor, least: float) -> Baked:
    """Return what is baked without splats that are never as opaque as ``least``.

    opacities (M,) are the largest of those that move.
    """
    largest = baked.splats.logit_opacities.sigmoid()
    largest[: baked.moving] = opacities
    rows = (largest >= least).nonzero().flatten()
    moving = rows[rows < baked.moving]
    bodies = baked.bodies
    if bodies is not None and bodies.body is not None:
        bodies = replace(bodies, body=bodies.body[moving])
    tracks = {
        name: Track(track.curves, track.shares if name in OF_BODIES else track.shares[moving])
        for name, track in baked.tracks.items()
    }
    lives = None if baked.lives is None else baked.lives[moving]
    splats = baked.splats.take(rows)
    return Baked(splats, len(moving), baked.times, bodies, tracks, lives)
