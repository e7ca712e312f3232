"""The Gaussian in time that is nearest to when a splat is there."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.model.times import inverse_durations
from gsdmsr_cli.moving.playing import exponents_of

ALWAYS = 65504.0
"""Width of a splat that is there always: the largest number of 16 bits."""

EARLIEST, LATEST = -0.5, 1.5
"""Between which centres lie: beyond, polynomials about them would say little of [0, 1]."""

TIMES, ROUNDS = 65, 30

_STARTS = [(centre / 8, 2.0**power) for centre in range(-4, 13) for power in range(-6, 4)]
"""Centres and widths from the nearest of which the search sets out."""


def gaussians_of(lives: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres and widths, (N,) float64: exp(-((t - centre) / width)^2) is what is there.

    lives are (N, 4), see ``moving.baked.Baked``. A life that is such a Gaussian gives that one; of
    others it is the nearest in the mean square over [0, 1].
    """
    lives = lives.double()
    first, last, appearing, vanishing = lives.unbind(1)
    middle = first.clamp(EARLIEST, LATEST)
    exact = (first == last) & (appearing == vanishing) & (middle == first)
    endless = (first <= 0) & (last >= 1)
    centres = torch.where(endless, 0.5, middle)
    widths = torch.where(endless, ALWAYS, 1 / inverse_durations(appearing))
    others = (~exact & ~endless).nonzero().flatten()
    if len(others):
        centres[others], widths[others] = _nearest(lives[others])
    return centres, widths.clamp(max=ALWAYS)


def _nearest(lives: Tensor) -> tuple[Tensor, Tensor]:
    """Return centres and widths, (N,), by the method of Levenberg and Marquardt."""
    times = torch.linspace(0, 1, TIMES, dtype=lives.dtype)
    wanted = torch.stack([torch.exp(-exponents_of(lives, float(time))) for time in times], dim=1)
    starts = lives.new_tensor(_STARTS)
    shapes = torch.exp(-(((times - starts[:, :1]) / starts[:, 1:]) ** 2))
    apart = shapes.square().sum(dim=1) - 2 * wanted @ shapes.mT
    centres, widths = starts[apart.argmin(dim=1)].unbind(1)
    logs, damping = widths.log(), torch.full_like(widths, 1e-3)
    for _ in range(ROUNDS):
        tried = _stepped(times, wanted, centres, logs, damping)
        errors = [_error(times, wanted, *each) for each in ((centres, logs), tried)]
        better = errors[1] < errors[0]
        centres, logs = (
            torch.where(better, new, old) for new, old in zip(tried, (centres, logs), strict=True)
        )
        damping = torch.where(better, damping / 3, damping * 5).clamp(1e-9, 1e9)
    return centres, logs.exp()


def _error(times: Tensor, wanted: Tensor, centres: Tensor, logs: Tensor) -> Tensor:
    offs = (times - centres[:, None]) / logs.exp()[:, None]
    return (torch.exp(-offs.square()) - wanted).square().sum(dim=1)


def _stepped(
    times: Tensor, wanted: Tensor, centres: Tensor, logs: Tensor, damping: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the centres and logarithms of widths after one damped step."""
    widths = logs.exp()[:, None]
    offs = (times - centres[:, None]) / widths
    shape = torch.exp(-offs.square())
    slopes = torch.stack([2 * offs * shape / widths, 2 * offs.square() * shape], dim=2)
    normal = slopes.mT @ slopes
    damped = torch.diag_embed(normal.diagonal(dim1=1, dim2=2) * damping[:, None] + 1e-12)
    pull = (slopes * (wanted - shape)[:, :, None]).sum(dim=1)
    step = torch.linalg.solve(normal + damped, pull)
    return (centres + step[:, 0]).clamp(EARLIEST, LATEST), (logs + step[:, 1]).clamp(-8, 11)
