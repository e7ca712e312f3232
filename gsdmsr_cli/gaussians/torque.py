"""What a loss says of turning and stretching all that is drawn, from its gradients by the splats.

Turning the world about a point, splats and their harmonics with it, is what turning the camera the
other way does to the picture, and stretching it along the line of sight what a shorter focal length
does. So the gradients of a camera need no kernel of their own.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from gsdmsr_cli.ground.geometry import SH_C0, sh_basis

Entry = tuple[int, int, float]


def torque(
    means: Tensor,
    quats: Tensor,
    axes: Tensor | None,
    sh: Tensor,
    d_means: Tensor | None,
    d_quats: Tensor | None,
    d_axes: Tensor | None,
    d_sh: Tensor | None,
    centre: Tensor,
) -> Tensor:
    """Return the gradient, (3,) float64, by a rotation vector about ``centre`` (3,) [1 / rad].

    Of a turn by a small vector v: means m move by v x (m - c), quaternions by (0, v / 2) q, axes by
    v x a, coefficients as ``turn_harmonics`` says. Gradients are None where they are 0; of splats
    with values that are not finite they must be 0.
    """
    total = torch.zeros(3, dtype=torch.float64, device=means.device)
    if d_means is not None:
        total += _sum(torch.linalg.cross(_finite(means) - centre.to(means), d_means))
    if d_quats is not None:
        total += _sum(_of_quats(_finite(quats), d_quats))
    if d_axes is not None and axes is not None:
        total += _sum(torch.linalg.cross(_finite(axes), d_axes, dim=1).sum(dim=2))
    if d_sh is not None:
        total += _of_harmonics(_finite(sh), d_sh)
    return total


def stretch(
    means: Tensor,
    axes: Tensor | None,
    sh: Tensor,
    d_means: Tensor | None,
    d_axes: Tensor | None,
    d_sh: Tensor | None,
    centre: Tensor,
    ahead: Tensor,
) -> Tensor:
    """Return the gradient, () float64, by a factor on all distances along a line of sight.

    Of a small step e: means m move by e d d^T (m - c), axes by e d d^T a with the unit vector
    ``ahead`` (3,), d, and ``centre`` (3,), c; colours stay those that were seen before. Gradients
    are None where they are 0; shapes are those of forms without axes, of which the covariances are
    not stretched.
    """
    total = torch.zeros((), dtype=torch.float64, device=means.device)
    along, arms = ahead.to(means), _finite(means) - centre.to(means)
    moved = (arms @ along)[:, None] * along
    if d_means is not None:
        total += (d_means * moved).sum(dtype=torch.float64)
    if d_axes is not None and axes is not None:
        both = along @ d_axes, along @ _finite(axes)
        total += (both[0] * both[1]).sum(dtype=torch.float64)
    degree = int(sh.shape[1] ** 0.5) - 1
    if d_sh is not None and degree:
        distances = arms.norm(dim=1, keepdim=True).clamp(min=torch.finfo(arms.dtype).tiny)
        ways = arms / distances
        turned = (moved - (moved * ways).sum(dim=1, keepdim=True) * ways) / distances
        _, slopes, *_ = torch.func.jvp(lambda d: sh_basis(d, degree), (ways,), (turned,))
        # the first of the basis is a constant, so its coefficients tell the gradients of colours
        colours = (slopes[:, :, None] * _finite(sh)).sum(dim=1)
        total -= (colours * d_sh[:, 0]).sum(dtype=torch.float64) / SH_C0
    return total


def _of_quats(quats: Tensor, d_quats: Tensor) -> Tensor:
    """Return g . (0, v / 2) q for v along each axis, (N, 3)."""
    w, x, y, z = quats.unbind(1)
    a, b, c, d = (d_quats / 2).unbind(1)
    turned = [b * w - a * x - c * z + d * y, c * w - a * y + b * z - d * x,
              d * w - a * z - b * y + c * x]  # fmt: skip
    return torch.stack(turned, dim=1)


def _of_harmonics(sh: Tensor, d_sh: Tensor) -> Tensor:
    """Return the torque (3,) on coefficients (N, K, 3)."""
    found = []
    for entries in generators(int(sh.shape[1] ** 0.5) - 1):
        parts = [f * (d_sh[:, k] * sh[:, j]).sum(dtype=torch.float64) for k, j, f in entries]
        found.append(torch.stack(parts).sum() if parts else sh.new_zeros((), dtype=torch.float64))
    return torch.stack(found)


@functools.cache
def generators(degree: int) -> tuple[tuple[Entry, ...], ...]:
    """Return how coefficients change as the world turns about x, about y and about z.

    Each is the entries (row, column, value) of a matrix that are not 0: coefficients c change by
    angle * matrix c. The harmonics Y of one degree span a space that turns do not leave, so values
    in more directions than it has dimensions determine the matrices: c . Y(d) stays the same while
    d turns along, hence matrix = -M^T where the derivative of Y along the turn is M Y.
    """
    generator = torch.Generator().manual_seed(0)
    ways = torch.randn(64, 3, generator=generator, dtype=torch.float64)
    ways /= ways.norm(dim=1, keepdim=True)
    found = []
    for axis in torch.eye(3, dtype=torch.float64):
        along = torch.linalg.cross(axis.expand_as(ways), ways)
        values, slopes, *_ = torch.func.jvp(lambda d: sh_basis(d, degree), (ways,), (along,))
        matrix = -torch.linalg.lstsq(values, slopes).solution
        rows, columns = torch.where(matrix.abs() > 1e-9)
        entries = zip(rows.tolist(), columns.tolist(), matrix[rows, columns].tolist(), strict=True)
        found.append(tuple(entries))
    return tuple(found)


def _finite(values: Tensor) -> Tensor:
    return values.nan_to_num(0.0, 0.0, 0.0)


def _sum(rows: Tensor) -> Tensor:
    return rows.sum(dim=0, dtype=torch.float64)
