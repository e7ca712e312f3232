"""Splats that follow control points, on CUDA kernels: as on the CPU and as the float64 twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cuda_shim
import pytest
import torch
from kernel_checks import assert_near, generator, leaves
from motion_checks import disturbed, moved_by, penalty_of, splats_of, started
from skinning_checks import control_points_of, guesses, learnt_from_33
from torch import Tensor

from gsdmsr_cli.backends.cuda import launch
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops import skin as skinning
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.ops.nearest import nearest_points

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")

TOLERANCE = 2e-5

COUNTS = 0, 1, 31, 33, 130
"""Numbers of splats: none, less than a warp, more than one, and more than a block."""


@pytest.fixture(params=[False, True], ids=["forwards", "backwards"])
def turns(request: pytest.FixtureRequest, kernels_on_the_cpu: cuda_shim.Shim) -> object:
    """Both orders in which blocks, warps and lanes take turns."""
    kernels_on_the_cpu.backwards = request.param
    yield
    kernels_on_the_cpu.backwards = False


def by_the_cpu(work: Callable[[], Sequence[Tensor]]) -> Sequence[Tensor]:
    """Do it by the kernels of the CPU."""
    kernels = launch.runners.pop("cpu")
    try:
        return work()
    finally:
        launch.runners["cpu"] = kernels


def lattice(count: int, seed: int) -> Tensor:
    """Points at whole numbers, of which many are equally far from each other, exactly."""
    return torch.randint(-3, 4, (count, 3), generator=generator(seed)).float()


@pytest.mark.parametrize("kept", [1, 5, 8, 20])
@pytest.mark.parametrize("size", [20, 100, 300])
@pytest.mark.parametrize("count", COUNTS)
def test_the_nearest_are_those_of_the_cpu_also_where_equally_near(
    turns: None, count: int, size: int, kept: int
) -> None:
    queries, points = lattice(count, 1), lattice(size, 2)
    (expected,) = by_the_cpu(lambda: [nearest_points(queries, points, guesses(count, kept))])
    rows = torch.randint(size, (count, kept), generator=generator(3)).int()
    for guess in (guesses(count, kept), expected, rows, rows.sort(dim=1).values):
        assert torch.equal(nearest_points(queries, points, guess), expected)


@pytest.mark.parametrize("kept", [1, 8, 11])
@pytest.mark.parametrize("count", COUNTS)
def test_the_nearest_are_those_of_the_twin(place: str, count: int, kept: int) -> None:
    queries, points = splats_of(count).means, control_points_of(70)[0]
    guess = guesses(count, kept)
    expected = nearest_points(queries.double(), points.double(), guess)
    given = queries.to(place), points.to(place)
    assert torch.equal(nearest_points(*given, guess.to(place)).cpu(), expected)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
@pytest.mark.parametrize("kept", [1, 8, 11])
def test_points_that_are_nowhere_get_valid_rows(kept: int, value: float) -> None:
    queries, points = splats_of(33).means, control_points_of(20)[0]
    expected = nearest_points(queries, points, guesses(33, kept))
    queries[7, 1] = value
    for guess in (guesses(33, kept), expected):
        found = nearest_points(queries, points, guess)
        assert found[7].min() >= 0 and found[7].max() < 20
        found[7] = expected[7]
        assert torch.equal(found, expected)


@pytest.mark.parametrize("size", [1, 31, 33, 200])
def test_transforms_and_their_gradients(place: str, turns: None, size: int) -> None:
    """Also where a quaternion is much shorter than 1, or has no length at all."""
    results = []
    for make, dtype in (
        (skinning.transforms, torch.float32),
        (skinning.transforms_twin, torch.float64),
    ):
        places, _, deformation = control_points_of(size)
        deformation[0, 3:7] = torch.tensor([-1.0, 0.0, 0.0, 0.0])
        deformation[-1, 3:7] = torch.tensor([-0.99, 0.0, 0.01, 0.0])
        own = leaves([places, deformation], dtype)
        made = make(*(t.to(place) for t in own)).cpu()
        (made * torch.randn(made.shape, generator=generator(5)).to(dtype)).sum().backward()
        results.append([made, *(t.grad for t in own)])
    for i, (found, exact) in enumerate(zip(*results, strict=True)):
        assert_near(found, exact, TOLERANCE, str(i))


def moved_and_learnt(
    move: object, dtype: torch.dtype, place: str, count: int, size: int, kept: int
) -> list[Tensor]:
    """Return what splats become, and the gradients of all that they follow from."""
    assert callable(move)
    splats, points = splats_of(count), control_points_of(size)
    near = nearest_points(splats.means.double(), points[0].double(), guesses(count, kept))
    stored = [splats.means, splats.quats, splats.log_scales]
    made = skinning.transforms_twin(points[0].double(), points[2].double())
    own = leaves([*stored, points[0], points[1], made], dtype)
    there = [t.to(place) for t in own]
    moving = Splats(*there[:3], *(t.to(place) for t in (splats.logit_opacities, splats.sh)))
    moved = move(moving, *there[3:], near.to(place))
    parts = torch.cat([moved.means, moved.quats, moved.log_scales], dim=1).cpu()
    slopes = torch.randn(parts.shape, generator=generator(5)).to(dtype)
    slopes[::3] = 0  # splats that nothing is to be learnt from
    parts.backward(slopes)
    return [parts, *(t.grad for t in own if t.grad is not None)]


@pytest.mark.parametrize(("size", "kept"), [(1, 1), (8, 8), (45, 1), (45, 8), (45, 11)])
@pytest.mark.parametrize("count", COUNTS)
def test_following_and_its_gradients(
    place: str, turns: None, count: int, size: int, kept: int
) -> None:
    given = count, size, kept
    found = moved_and_learnt(skinning.skin, torch.float32, place, *given)
    exact = moved_and_learnt(skinning.skin_twin, torch.float64, "cpu", *given)
    cpu = by_the_cpu(lambda: moved_and_learnt(skinning.skin, torch.float32, "cpu", *given))
    assert len(found) == len(exact) == len(cpu) == 7
    for i, (one, truth, other) in enumerate(zip(found, exact, cpu, strict=True)):
        assert_near(one, truth, TOLERANCE, f"result {i}")
        assert_near(one, other, TOLERANCE, f"result {i} of the CPU's kernels")


@pytest.mark.parametrize("times", [1, 3])
@pytest.mark.parametrize("count", COUNTS)
def test_several_times_are_one_after_the_other(
    place: str, turns: None, count: int, times: int
) -> None:
    """What is learnt at each time from some splats, from others at others, as the twin learns."""
    rng = generator(7)
    deformations = torch.randn(times, 45, OUTPUTS, generator=rng)
    slopes = torch.randn(times, count, 10, generator=rng)
    slopes[torch.arange(times)[:, None] == torch.arange(count) % 4] = 0
    results = []
    for dtype, on in ((torch.float32, place), (torch.float64, "cpu")):
        splats, points = splats_of(count), control_points_of(45)
        near = nearest_points(splats.means.double(), points[0].double(), guesses(count, 8))
        given = [splats.means, splats.quats, splats.log_scales, *points[:2], deformations]
        own = leaves(given, dtype)
        *stored, places, log_radii, moves = (t.to(on) for t in own)
        made = skinning.transforms(places, moves)
        still = Splats(*stored, *(t.to(on) for t in (splats.logit_opacities, splats.sh)))
        moved = skinning.skin_at_times(still, places, log_radii, made, near.to(on))
        assert len(moved) == times
        rows = [torch.cat([m.means, m.quats, m.log_scales], dim=1) for m in moved]
        parts = torch.stack(rows).cpu()
        parts.backward(slopes.to(dtype))
        results.append([made.cpu(), parts, *(t.grad for t in own)])
    for i, (found, exact) in enumerate(zip(*results, strict=True)):
        assert_near(found, exact, TOLERANCE, f"result {i}")


def test_splats_that_are_not_finite_teach_nothing(turns: None) -> None:
    """To the last bit what is learnt where they are finite, since they pass no gradient."""
    found, expected = (
        learnt_from_33(skinning.skin, torch.float32, finite) for finite in (False, True)
    )
    for one, other in zip(found, expected, strict=True):
        assert other.any() and torch.equal(one, other)


def test_the_motion_moves_by_them_as_by_the_kernels_of_the_cpu(
    kernels_on_the_cpu: cuda_shim.Shim, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, run = [], kernels_on_the_cpu.launch
    monkeypatch.setattr(
        kernels_on_the_cpu, "launch", lambda *given: (asked.append(given[1]), run(*given))
    )

    def moved() -> list[Tensor]:
        motion, splats = disturbed(started("control_points")), splats_of(50).map(torch.nn.Parameter)
        at, penalty = moved_by(motion, splats, 0.3), penalty_of(motion, splats, 0.3, generator())
        assert penalty is not None
        total = at.means.square().sum() + at.quats.square().sum() + at.log_scales.sum() + penalty
        tensors = list(motion.tensors().values())
        return [at.means, at.quats, penalty, *torch.autograd.grad(total, tensors)]

    found = moved()
    assert {"nearest", "transform", "skin", "transform_backward", "skin_backward"} <= set(asked)
    asked.clear()
    expected = by_the_cpu(moved)
    assert not asked
    for i, (one, other) in enumerate(zip(found, expected, strict=True)):
        assert_near(one, other, TOLERANCE, str(i))
