"""Splats move as few rigid bodies do: their velocities fit as many rigid velocity fields.

ReMatching (Oblak et al., ICLR 2025): the distance of the velocities from the nearest field of a
class, here that of piecewise rigid ones, omega x (x - c) + b. There a network learns which part a
point belongs to; here parts are found for each view anew, each splat going to the field that fits
it best, a few rounds (Lloyd 1982).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.options.strict import require
from gsdmsr_cli.training.losses import Seen
from gsdmsr_cli.training.losses._comparing import ComparingTerm, Schedule, finite_rows_of, nothing

ROUNDS = 4
"""How many times fields are fitted and splats go to the best of them."""

_STIFFNESS = 1e-6
"""Least moment of inertia of a part, as a share of its trace: a line has none about itself."""


@dataclass(frozen=True)
class Options(Schedule):
    """Settings; see ``Schedule``.

    Attributes:
        factor: weight of the mean squared deviation.
        parts: number of rigid velocity fields.
        samples: splats that are looked at, chosen at random for each view.
    """

    factor: float = 1e-4
    parts: int = 8
    samples: int = 2048

    def __post_init__(self) -> None:
        super().__post_init__()
        for key in ("parts", "samples"):
            require(self, key, getattr(self, key) >= 1, "1 or more")


class Fields(NamedTuple):
    """P rigid velocity fields: turns (P, 3), centres (P, 3) and velocities there (P, 3)."""

    turns: Tensor
    centres: Tensor
    velocities: Tensor

    def at(self, places: Tensor, part: Tensor) -> Tensor:
        """Return the velocity (S, 3) of a field each, ``part`` (S,), at places (S, 3)."""
        turned: Tensor = torch.linalg.cross(self.turns[part], places - self.centres[part])
        return self.velocities[part] + turned


class RigidVelocity(ComparingTerm):
    """The mean of |v - w|^2 [(world units / capture)^2], w being the best of the fields.

    v is the way to an adjacent train time over that time, taken half-way between the two places:
    there every rigid movement, whatever its angle, has a rigid velocity (Cayley's transform).
    """

    needs_seed = True

    def __init__(self, options: Options) -> None:
        super().__init__(options)
        self.options = options

    def __call__(self, seen: Seen) -> Tensor:
        """Return the mean ()."""
        if seen.other is None or seen.other_instant is None:
            return nothing(seen)
        now, other = seen.moment.splats, seen.other.splats
        rows = finite_rows_of(now, other)
        shuffled = torch.randperm(len(rows), generator=torch.Generator().manual_seed(seen.seed))
        rows = rows[shuffled[: self.options.samples].to(rows.device)]
        if not len(rows):
            return nothing(seen)
        after, before = now.means[rows], other.means[rows]
        places = (after + before) / 2
        velocities = (after - before) / (seen.instant.time - seen.other_instant.time)
        fields, part = nearest_fields(places.detach(), velocities.detach(), self.options.parts)
        return (velocities - fields.at(places, part)).square().sum(dim=1).mean()


def nearest_fields(places: Tensor, velocities: Tensor, parts: int) -> tuple[Fields, Tensor]:
    """Return rigid velocity fields that fit, and which of them each place has, (S,).

    Args:
        places: (S, 3), the first of which the parts begin around.
        velocities: (S, 3).
        parts: how many fields at most.
    """
    part = torch.cdist(places, places[:parts]).argmin(dim=1)
    for _ in range(ROUNDS):
        fields = _fit(places, velocities, part, parts)
        every = torch.arange(parts, device=part.device)
        off = [velocities - fields.at(places, each.expand_as(part)) for each in every]
        part = torch.stack([one.square().sum(dim=1) for one in off]).argmin(dim=0)
    return _fit(places, velocities, part, parts), part


def _fit(places: Tensor, velocities: Tensor, part: Tensor, parts: int) -> Fields:
    """Return the field of each part that fits its velocities best, by least squares."""
    counts = part.bincount(minlength=parts).clamp(min=1)[:, None].to(places)
    centres, means = (_sums(values, part, parts) / counts for values in (places, velocities))
    arms, own = places - centres[part], velocities - means[part]
    spread = _sums((arms[:, :, None] * arms[:, None]).flatten(1), part, parts).unflatten(1, (3, 3))
    eye = torch.eye(3, dtype=places.dtype, device=places.device)
    trace = spread.diagonal(dim1=1, dim2=2).sum(dim=1)[:, None, None]
    inertia = trace * eye - spread + (_STIFFNESS * trace + torch.finfo(places.dtype).tiny) * eye
    momentum = _sums(torch.linalg.cross(arms, own), part, parts)
    return Fields(torch.linalg.solve(inertia, momentum), centres, means)


def _sums(values: Tensor, part: Tensor, parts: int) -> Tensor:
    """Return the sum of the values (S, C) of each part, (P, C)."""
    return values.new_zeros(parts, values.shape[1]).index_add_(0, part, values)


def start(options: Options) -> RigidVelocity:
    """Return the term."""
    return RigidVelocity(options)
