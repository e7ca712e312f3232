"""Curves in time that many rows share: how channels of bodies or splats change.

Each channel of each row is a weighted sum of few curves. The curves are the principal components of
all channels over time, so that no other set of as few comes closer: a polynomial motion of degree d
needs d + 1 of them, a Fourier series two a frequency, and a smooth field some ten.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEGLIGIBLE = 1e-7
"""Components of less than this share of the largest are rounding."""


@dataclass(frozen=True, eq=False)
class Track:
    """Channels C of rows n that change in time.

    Attributes:
        curves: (T, R) values at times i / (T - 1).
        shares: (n, C, R) how much of each curve a channel has.
    """

    curves: Tensor
    shares: Tensor

    def at(self, time: float) -> Tensor:
        """Return the channels (n, C) at a time in [0, 1]."""
        return self.shares @ curves_at(self.curves, time)


def track_of(samples: Tensor) -> Track:
    """Return the track that goes through samples (n, C, T), its curves in order of importance.

    The curves are orthonormal, so what rounding shares adds is the same for all of them.
    """
    rows = samples.reshape(-1, samples.shape[2]).double()
    values, vectors = torch.linalg.eigh(rows.T @ rows)
    values, vectors = values.flip(0), vectors.flip(1)
    kept = int((values > NEGLIGIBLE**2 * values[:1].clamp(min=1e-30)).sum())
    curves = vectors[:, :kept]
    shares = (rows @ curves).unflatten(0, samples.shape[:2])
    return Track(curves.to(samples), shares.to(samples))


def curves_at(curves: Tensor, time: float) -> Tensor:
    """Return the curves (R,) of values (T, R) at a time: cubics between neighbouring values.

    Catmull and Rom's (1974); at the ends the slope is that to the only neighbour.
    """
    count = len(curves)
    if count == 1:
        return curves[0]
    place = min(max(time, 0.0), 1.0) * (count - 1)
    i = min(int(place), count - 2)
    f = place - i
    before, first, second, after = (curves[min(max(i + k, 0), count - 1)] for k in (-1, 0, 1, 2))
    slope = (second - before) / (2 if i else 1)
    further = (after - first) / (2 if i + 2 < count else 1)
    square, cube = f * f, f * f * f
    return (
        (2 * cube - 3 * square + 1) * first
        + (cube - 2 * square + f) * slope
        + (3 * square - 2 * cube) * second
        + (cube - square) * further
    )
