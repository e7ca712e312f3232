"""What a loss says of turning the world, against the world turned by a little."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.gaussians.torque import stretch, torque
from gsdmsr_cli.gaussians.turning import turn_harmonics
from gsdmsr_cli.ground.geometry import SH_C0, quat_product, sh_basis

CENTRE = torch.tensor([0.4, -1.2, 0.7], dtype=torch.float64)


def random_splats(degree: int, count: int = 6) -> tuple[Splats, Tensor]:
    """Return float64 splats and axes (N, 3, 3)."""
    rng = generator(degree)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3), (3, 3)]
    *five, axes = (torch.randn(count, *s, generator=rng).double() for s in shapes)
    return Splats(*five), axes


def turned(splats: Splats, axes: Tensor, by: Tensor) -> list[Tensor]:
    """Return means, quats, axes and harmonics after a turn by a rotation vector about CENTRE."""
    x, y, z = by.tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    rotation = torch.linalg.matrix_exp(cross)
    half = by.norm() / 2
    quat = torch.cat([half.cos()[None], torch.sinc(half / torch.pi) * by / 2])
    return [
        (splats.means - CENTRE) @ rotation.mT + CENTRE,
        quat_product(quat.expand_as(splats.quats), splats.quats),
        rotation @ axes,
        turn_harmonics(splats.sh, rotation),
    ]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_it_is_the_slope_of_any_function_of_turned_splats(degree: int) -> None:
    splats, axes = random_splats(degree)
    rng = generator(9)
    now = turned(splats, axes, torch.zeros(3, dtype=torch.float64))
    slopes = [torch.randn(t.shape, generator=rng).double() for t in now]

    def value(by: Tensor) -> Tensor:
        pairs = zip(turned(splats, axes, by), slopes, strict=True)
        return sum(((t * slope).sum() for t, slope in pairs), torch.zeros(()))

    eps, along = 1e-5, torch.eye(3, dtype=torch.float64)
    expected = torch.stack([(value(eps * v) - value(-eps * v)) / (2 * eps) for v in along])
    d_means, d_quats, d_axes, d_sh = slopes
    given = splats.means, splats.quats, axes, splats.sh, d_means, d_quats, d_axes, d_sh
    torch.testing.assert_close(torque(*given, CENTRE), expected, rtol=1e-8, atol=1e-8)


def test_gradients_that_are_not_there_say_nothing() -> None:
    splats, axes = random_splats(1)
    found = torque(splats.means, splats.quats, axes, splats.sh, None, None, None, None, CENTRE)
    assert torch.equal(found, torch.zeros(3, dtype=torch.float64))


def test_splats_that_are_not_finite_have_no_part() -> None:
    """Engines leave them out and give them the gradient 0."""
    splats, _ = random_splats(1)
    given = splats.means, splats.quats, None, splats.sh
    slopes = [torch.ones_like(t) for t in (splats.means, splats.quats, splats.sh)]
    for tensor in slopes:
        tensor[2] = 0
    expected = torque(*given, slopes[0], slopes[1], None, slopes[2], CENTRE)
    for tensor in (splats.means, splats.quats, splats.sh):
        tensor[2] = torch.nan
    assert torch.equal(torque(*given, slopes[0], slopes[1], None, slopes[2], CENTRE), expected)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_stretching_leaves_the_colours_that_were_seen(degree: int) -> None:
    """Means and axes go along, directions of colours do not."""
    splats, axes = random_splats(degree)
    rng = generator(11)
    ahead = torch.nn.functional.normalize(torch.randn(3, generator=rng).double(), dim=0)
    d_colours = torch.randn(6, 3, generator=rng).double()
    direct, d_axes = (torch.randn(t.shape, generator=rng).double() for t in (splats.means, axes))

    def colours(means: Tensor) -> Tensor:
        ways = torch.nn.functional.normalize(means - CENTRE, dim=1)
        return (sh_basis(ways, degree)[:, :, None] * splats.sh).sum(dim=1)

    means = splats.means.clone().requires_grad_()
    seen = (colours(means) * d_colours).sum() + 0 * means.sum()
    (by_colours,) = torch.autograd.grad(seen, means)
    ways = torch.nn.functional.normalize(splats.means - CENTRE, dim=1)
    d_sh = sh_basis(ways, degree)[:, :, None] * d_colours[:, None]
    torch.testing.assert_close(d_sh[:, 0], SH_C0 * d_colours)
    given = splats.means, axes, splats.sh, direct + by_colours, d_axes, d_sh
    outer = ahead[:, None] * ahead
    expected = ((splats.means - CENTRE) @ outer * direct).sum() + (outer @ axes * d_axes).sum()
    torch.testing.assert_close(stretch(*given, CENTRE, ahead), expected, rtol=1e-8, atol=1e-8)
    nothing = stretch(splats.means, axes, splats.sh, None, None, None, CENTRE, ahead)
    assert nothing == 0
