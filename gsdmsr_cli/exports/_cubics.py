"""Splats on cubics of time that turn at a constant rate, fitted to how those of a model move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.exports._lifetimes import ALWAYS, gaussians_of
from gsdmsr_cli.exports._moving import Moving
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN

LARGEST = 65504.0
"""Of the numbers of 16 bits."""

GROWTH = 1e-8
"""What quaternions that grow instead of turning count, which changes nothing that is seen."""

CHUNK = 8192
"""Splats whose rotations are fitted at once, for less memory."""

FAINTEST = 1e-2
"""Splats weigh as much as they are opaque, and this at least: paths go on where they are gone."""


@dataclass(frozen=True, eq=False)
class Cubics:
    """N splats that move with the time dt since their centres, whose numbers have 16 bits.

    Attributes:
        splats: at their centres; quaternions of any length, degree 0.
        paths: (N, 3, 3) of which dt, dt^2 and dt^3 times the rows are added to the means.
        rates: (N, 4), dt times which is added to the quaternions.
        centres: (N,) times.
        widths: (N,), exp(-(dt / width)^2) of the opacity is seen.
        off: how far from the model: "centres" [units of the file], "turns" [rad] and "opacities",
            (T, N) each, 0 where nothing is seen of a splat.
    """

    splats: Splats
    paths: Tensor
    rates: Tensor
    centres: Tensor
    widths: Tensor
    off: dict[str, Tensor]


def halves(values: Tensor) -> Tensor:
    """Return the nearest numbers of 16 bits, float64."""
    return values.clamp(-LARGEST, LARGEST).half().double()


def fit(moving: Moving, times: Sequence[float]) -> Cubics:
    """Return the cubics that are nearest to the splats at the times, 4 or more."""
    whole = [moving.endless(time) for time in times]
    seen = torch.stack([moving.at(time).logit_opacities.sigmoid().double() for time in times])
    count, t = len(whole[0]), torch.tensor(times, dtype=torch.float64)
    centres, widths = torch.full((count,), 0.5).double(), torch.full((count,), ALWAYS).double()
    if moving.lives is not None:
        centres, widths = gaussians_of(moving.lives)
    centres, widths = halves(centres), halves(widths).clamp(min=2.0**-24)
    dt = t[:, None] - centres
    weights = seen.clamp(min=FAINTEST).square()
    means, quats = _stacked(whole, "means"), _in_one_half(_stacked(whole, "quats"))
    places, paths = _split(_least_squares(dt, means, weights, 3))
    places, paths = places.float().double(), halves(paths)
    turns, rates = (halves(part) for part in _turning(dt, quats, weights))
    opacities = _stacked(whole, "logit_opacities").sigmoid().mean(dim=0)
    splats = Splats(
        places, turns, _stacked(whole, "log_scales").mean(dim=0), opacities.logit(),
        _stacked(whole, "sh").mean(dim=0)[:, :1],
    )  # fmt: skip
    shown = opacities * torch.exp(-(dt / widths).square())
    visible = torch.maximum(shown, seen) >= ALPHA_MIN
    at = torch.einsum("tnk,nkc->tnc", _powers(dt, 3)[..., 1:], paths) + places
    off = {
        "centres": (at - means).norm(dim=2) * visible,
        "turns": _angles(turns + dt[..., None] * rates, quats) * visible,
        "opacities": (shown - seen).abs(),
    }
    return Cubics(splats, paths, rates, centres, widths, off)


def _stacked(splats: Sequence[Splats], name: str) -> Tensor:
    return torch.stack([getattr(each, name).double() for each in splats])


def _in_one_half(quats: Tensor) -> Tensor:
    """Return quaternions (T, N, 4) whose signs are those of the ones in the middle."""
    middle = quats[len(quats) // 2]
    return torch.where((quats * middle).sum(dim=2, keepdim=True) < 0, -quats, quats)


def _powers(dt: Tensor, degree: int) -> Tensor:
    return dt[..., None] ** torch.arange(degree + 1, dtype=dt.dtype)


def _least_squares(dt: Tensor, values: Tensor, weights: Tensor, degree: int) -> Tensor:
    """Return the coefficients (N, degree + 1, C) of polynomials through values (T, N, C)."""
    powers = _powers(dt, degree)
    normal = torch.einsum("tn,tni,tnj->nij", weights, powers, powers)
    right = torch.einsum("tn,tni,tnc->nic", weights, powers, values)
    solution: Tensor = torch.linalg.solve(normal, right)
    return solution


def _turning(dt: Tensor, quats: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return quaternions at dt = 0 and rates, (N, 4) each, of lines near quaternions (T, N, 4).

    The line that is nearest to the quaternions turns too slowly, the one of the nearest directions
    may go through nothing where a splat turns far: whichever comes closer is taken.
    """
    places, rates = _split(_least_squares(dt, quats, weights, 1))
    lines = torch.cat([places, rates[:, 0]], dim=1), _directed(dt, quats, weights)
    apart = [
        (weights * _angles(line[:, :4] + dt[..., None] * line[:, 4:], quats).square()).sum(dim=0)
        for line in lines
    ]
    nearest = torch.where((apart[0] < apart[1])[:, None], *lines)
    return nearest[:, :4], nearest[:, 4:]


def _directed(dt: Tensor, quats: Tensor, weights: Tensor) -> Tensor:
    """Return a and b (N, 8) of the lines a + dt b whose directions are those of the quaternions.

    Lengths of quaternions say nothing, so what is least in the mean square is the part of a line
    at right angles to the quaternions: a quadratic form of a and b, whose eigenvector of the least
    eigenvalue they are.
    """
    pieces = (torch.split(tensor, CHUNK, dim=1) for tensor in (dt, quats, weights))
    forms = [_form(*piece) for piece in zip(*pieces, strict=True)]
    vectors = torch.linalg.eigh(torch.cat(forms)).eigenvectors[:, :, 0]
    lines: Tensor = vectors / vectors[:, :4].norm(dim=1, keepdim=True)
    return lines


def _form(dt: Tensor, quats: Tensor, weights: Tensor) -> Tensor:
    """Return the quadratic forms of lines, (N, 8, 8)."""
    along = weights[..., None, None] * quats[..., :, None] * quats[..., None, :]
    across = weights[..., None, None] * torch.eye(4, dtype=quats.dtype) - along
    powers = _powers(dt, 1)
    form = torch.einsum("tni,tnj,tnkl->nikjl", powers, powers, across)
    form[:, 1, :, 1] += GROWTH * along.sum(dim=0)
    return form.reshape(-1, 8, 8)


def _split(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Return the constants (N, C), and the other coefficients."""
    return coefficients[:, 0], coefficients[:, 1:]


def _angles(first: Tensor, second: Tensor) -> Tensor:
    """Return by what angles [rad] rotations differ that quaternions (..., 4) stand for."""
    first, second = (torch.nn.functional.normalize(each, dim=-1) for each in (first, second))
    chord = torch.minimum((first - second).norm(dim=-1), (first + second).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1))
