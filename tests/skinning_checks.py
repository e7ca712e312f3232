"""Control points for splats to follow, and their gradients where some splats are not finite."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from kernel_checks import generator, leaves
from motion_checks import splats_of
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.ops.skin import transforms

Move = Callable[[Splats, Tensor, Tensor, Tensor, Tensor], Splats]
"""``ops.skin.skin`` or another form of it."""

LOST = [0, 13, 32]
"""Which of 33 splats are not finite: the first, the last, and one among others."""


def control_points_of(count: int, seed: int = 3) -> list[Tensor]:
    """Return places, log radii and deformations of control points."""
    rng = generator(seed)
    places = torch.randn(count, 3, generator=rng)
    radii = 0.3 * torch.randn(count, generator=rng) - 1
    return [places, radii, 0.3 * torch.randn(count, OUTPUTS, generator=rng)]


def guesses(count: int, kept: int) -> Tensor:
    return torch.zeros(count, kept, dtype=torch.int32)


def learnt_from_33(move: Move, dtype: torch.dtype, finite: bool) -> list[Tensor]:
    """Return gradients of control points, log radii and deformations; those ``LOST`` pass none.

    Args:
        move: how splats follow control points.
        dtype: of all tensors.
        finite: whether the splats ``LOST`` are finite all the same.
    """
    splats = splats_of(33).map(lambda t: t.to(dtype))
    near = nearest_points(splats.means, control_points_of(20)[0].to(dtype), guesses(33, 4))
    slopes = torch.randn(33, 10, generator=generator(5)).to(dtype)
    slopes[LOST] = 0
    if not finite:
        for row, value in zip(LOST, (math.nan, math.inf, -math.inf), strict=True):
            splats.means[row, 1], splats.quats[row, 2] = value, math.nan
    own = leaves(control_points_of(20), dtype)
    near = nearest_points(splats.means, own[0].detach(), near)
    assert near.min() >= 0 and near.max() < 20
    splats = splats.map(lambda t: t.requires_grad_())
    moved = move(splats, own[0], own[1], transforms(own[0], own[2]), near)
    together = torch.cat([moved.means, moved.quats, moved.log_scales], dim=1)
    together.backward(slopes)  # type: ignore[no-untyped-call]
    return [tensor.grad for tensor in own if tensor.grad is not None]
