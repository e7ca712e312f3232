"""Splats that follow control points: the twin by hand, kernels against the twin."""

from __future__ import annotations

import math

import pytest
import torch
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from motion_checks import splats_of
from skinning_checks import Move, control_points_of, guesses, learnt_from_33
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.model.motion._rigidity import rigidity
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.ops.skin import skin, skin_twin, transforms, transforms_twin
from gsdmsr_cli.ops.spread import spacing


@pytest.mark.parametrize("move", [skin, skin_twin])
def test_one_point_takes_splats_along_as_a_rigid_body(move: object) -> None:
    """A quarter turn about z around the point, then its offset; the ellipsoids turn as well."""
    assert callable(move)
    point, offset = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[0.1, 0.2, 0.3]])
    turn = torch.tensor([[math.cos(math.pi / 4) - 1, 0.0, 0.0, math.sin(math.pi / 4)]])
    deformation = torch.cat([offset, turn, torch.full((1, 3), 0.5)], dim=1)
    splats = splats_of(5)
    moved = move(splats, point, torch.zeros(1), transforms(point, deformation), guesses(5, 1))
    x, y, z = (splats.means - point).unbind(1)
    expected = torch.stack([-y, x, z], dim=1) + point + offset
    torch.testing.assert_close(moved.means, expected, rtol=1e-5, atol=1e-6)
    quarter = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = quarter @ quat_to_rotmat(splats.quats)
    torch.testing.assert_close(quat_to_rotmat(moved.quats), turned, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(moved.log_scales, splats.log_scales + 0.5)
    assert moved.sh is splats.sh and moved.logit_opacities is splats.logit_opacities


def test_nearer_points_weigh_more_and_radii_say_by_how_much() -> None:
    """Two points at distance 1 and 2 of radius 1: weights 1 : exp(-(4 - 1) / 2)."""
    points = torch.tensor([[1.0, 0.0, 0.0], [-2.0, 0.0, 0.0]])
    deformation = torch.zeros(2, OUTPUTS)
    deformation[0, 1], deformation[1, 2] = 1.0, 1.0
    splats = splats_of(1)
    splats.means.zero_()
    near = torch.tensor([[0, 1]], dtype=torch.int32)
    moved = skin(splats, points, torch.zeros(2), transforms(points, deformation), near)
    second = 1 / (1 + math.exp(1.5))
    torch.testing.assert_close(moved.means, torch.tensor([[0.0, 1 - second, second]]))


def test_rigid_points_are_rigid() -> None:
    """All of them turn about one axis that is none of theirs, and go on."""
    points, _, _ = control_points_of(30)
    turn = torch.nn.functional.normalize(torch.tensor([[1.0, 0.2, -0.4, 0.3]]))
    goes = points @ quat_to_rotmat(turn)[0].T + torch.tensor([0.5, -2.0, 1.0])
    rest = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    deformation = torch.cat(
        [goes - points, (turn - rest).expand(30, 4), torch.zeros(30, 3)], dim=1
    ).requires_grad_()
    near = nearest_points(points, points, guesses(30, 5))
    value = rigidity(points, transforms(points, deformation), near)
    value.backward()
    assert 0 <= value < 1e-9
    assert deformation.grad is not None and deformation.grad.abs().max() < 1e-5
    bent = deformation.detach().clone()
    bent[3, 4:7] += 0.1
    assert rigidity(points, transforms(points, bent), near) > 1e-5


def test_rigidity_is_relative_to_the_distance() -> None:
    """Two points 2 apart, one of which goes 0.3 away: 0.15 squared, in half of the pairs."""
    points = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    deformation = torch.zeros(2, OUTPUTS)
    deformation[0, 1] = 0.3
    near = torch.tensor([[0, 1], [0, 1]], dtype=torch.int32)
    for unit in (1.0, 7.0):
        deformation[0, 1] = 0.3 * unit
        value = rigidity(unit * points, transforms(unit * points, deformation), near)
        torch.testing.assert_close(value, torch.tensor(0.5 * 0.15**2))


def test_points_almost_at_one_place_do_not_outweigh_the_others() -> None:
    """Their square counts as a ten thousandth of the mean, which is 2 / 3 of three pairs."""
    points = torch.tensor([[0.0, 0.0, 0.0], [1e-6, 0.0, 0.0], [1.0, 0.0, 0.0]])
    deformation = torch.zeros(3, OUTPUTS)
    deformation[1, 1] = 0.3
    near = torch.tensor([[1, 2], [0, 2], [0, 1]], dtype=torch.int32)
    value = rigidity(points, transforms(points, deformation), near)
    expected = (2 * 0.09 / (1e-4 * 2 / 3) + 2 * 0.09) / 6
    assert value.item() == pytest.approx(expected, rel=1e-4)


def test_points_at_one_place_are_rigid_with_each_other() -> None:
    points = torch.tensor([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    deformation = torch.zeros(3, OUTPUTS, requires_grad=True)
    near = torch.tensor([[0, 1], [0, 1], [0, 2]], dtype=torch.int32)
    value = rigidity(points, transforms(points, deformation), near)
    value.backward()
    assert value == 0
    assert deformation.grad is not None and not deformation.grad.any()


@pytest.mark.parametrize(("count", "kept"), [(0, 4), (1, 1), (333, 4), (200, 20)])
def test_the_kernel_matches_the_twin(count: int, kept: int) -> None:
    results = []
    near = nearest_points(splats_of(count).means, control_points_of(20)[0], guesses(count, kept))
    for move, dtype in ((skin, torch.float32), (skin_twin, torch.float64)):
        splats = splats_of(count).map(lambda t, to=dtype: t.to(to, copy=True).requires_grad_())
        points, log_radii, deformation = leaves(control_points_of(20), dtype)
        moved = move(splats, points, log_radii, transforms(points, deformation), near)
        parts = [moved.means, moved.quats, moved.log_scales]
        rng = generator(5)
        loss = sum((part * torch.randn(part.shape, generator=rng)).sum() for part in parts)
        assert isinstance(loss, Tensor)
        loss.backward()
        inputs = [splats.means, splats.quats, splats.log_scales, points, log_radii, deformation]
        results.append([*parts, *(tensor.grad for tensor in inputs)])
    for i, (found, exact) in enumerate(zip(*results, strict=True)):
        assert_near(found, exact, 1e-5, str(i))


def test_the_kernel_of_transforms_matches_the_twin() -> None:
    """Also where a quaternion is much shorter or longer than 1, or has no length at all."""
    results = []
    for make, dtype in ((transforms, torch.float32), (transforms_twin, torch.float64)):
        places, _, given = control_points_of(40)
        given[0], given[1, 3:7], given[2, 3:7] = 0.0, 3.0, torch.tensor([-0.99, 0.0, 0.01, 0.0])
        given[3, 3:7] = torch.tensor([-1.0, 0.0, 0.0, 0.0])
        points, deformation = leaves([places, given], dtype)
        made = make(points, deformation)
        weights = torch.randn(made.shape, generator=generator(5)).to(dtype)
        (made * weights).sum().backward()
        results.append([made, points.grad, deformation.grad])
    for found, expected in zip(*results, strict=True):
        assert found is not None and expected is not None
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-4)


def test_the_twin_s_gradients_are_those_of_finite_differences() -> None:
    stored = splats_of(3).map(lambda t: t.double())
    near = nearest_points(stored.means, control_points_of(6)[0].double(), guesses(3, 3))

    def moved(means: Tensor, quats: Tensor, *by: Tensor) -> tuple[Tensor, ...]:
        points, log_radii, deformation = by
        own = Splats(means, quats, stored.log_scales, stored.logit_opacities, stored.sh)
        found = skin_twin(own, points, log_radii, transforms(points, deformation), near)
        return found.means, found.quats, found.log_scales

    given = leaves([stored.means, stored.quats, *control_points_of(6)], torch.float64)
    assert torch.autograd.gradcheck(moved, given)


@pytest.mark.parametrize(
    ("move", "dtype"),
    [(skin, torch.float32), (skin_twin, torch.float32), (skin_twin, torch.float64)],
)
def test_splats_that_are_not_finite_teach_nothing(move: Move, dtype: torch.dtype) -> None:
    """To the last bit what is learnt where they are finite, since they pass no gradient."""
    found, expected = (learnt_from_33(move, dtype, finite) for finite in (False, True))
    for one, other in zip(found, expected, strict=True):
        assert other.any() and torch.equal(one, other)


def test_a_point_that_is_followed_alone_learns_nothing_by_its_weight() -> None:
    """The weight is 1 wherever it is: no gradient to its place and radius, not the least."""
    splats = splats_of(300)
    points, log_radii, deformation = control_points_of(20)
    made = transforms(points, deformation).requires_grad_()
    own = leaves([points, log_radii], torch.float32)
    near = nearest_points(splats.means, points, guesses(300, 1))
    moved = skin(splats, own[0], own[1], made, near)
    (moved.means.square().sum() + moved.quats.sum() + moved.log_scales.sum()).backward()
    assert made.grad is not None and made.grad.any()
    for tensor in own:
        assert tensor.grad is not None and not tensor.grad.any()


def test_spacing_is_that_of_a_lattice() -> None:
    axis = torch.arange(4.0)
    lattice = 0.25 * torch.cartesian_prod(axis, axis, axis)
    torch.testing.assert_close(spacing(lattice), torch.full((64,), 0.25))


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    def compute() -> list[Tensor]:
        splats = splats_of(500).map(torch.nn.Parameter)
        points, log_radii, deformation = leaves(control_points_of(40), torch.float32)
        near = nearest_points(splats.means, points, guesses(500, 4))
        moved = skin(splats, points, log_radii, transforms(points, deformation), near)
        (moved.means.square().sum() + moved.quats.square().sum()).backward()
        found = [splats.means, splats.quats, points, log_radii, deformation]
        gradients = [tensor.grad for tensor in found]
        return [near, moved.means, *(g for g in gradients if g is not None)]

    assert_same_on_threads(compute)


def test_splats_far_from_all_points_follow_the_nearest() -> None:
    """At any distance, since powers of 2 overflow at one and wrap round at another."""
    splats, (points, log_radii, deformation) = splats_of(4000), control_points_of(20)
    splats.means[:3000, 0] += torch.linspace(0, 12, 3000)
    splats.means[1000] = float("nan")  # which those after it have nothing to do with
    near = nearest_points(splats.means, points, guesses(4000, 5))
    given = points, torch.full_like(log_radii, -1.5), transforms(points, deformation), near
    found, exact = skin(splats, *given), skin_twin(splats, *given)
    finite = torch.arange(4000) != 1000
    for name in ("means", "quats", "log_scales"):
        mine, twin = getattr(found, name)[finite], getattr(exact, name)[finite]
        torch.testing.assert_close(mine, twin, rtol=1e-4, atol=1e-4, msg=name)
