"""Plane lookups and penalties on CUDA kernels are their plain torch twins in float64."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, generator, leaves
from torch import Tensor

from gsdmsr_cli.cuda import grids
from gsdmsr_cli.cuda.compiler import MOST_LEVELS
from gsdmsr_cli.fields import planes

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")

BOX = (-1.0, -2.0, -0.5), (1.5, 1.0, 2.0)
TOLERANCE = 2e-5


def levels(*shapes: tuple[int, int, int], seed: int = 0) -> list[planes.Level]:
    """Levels of (resolution, times, channels), whose temporal planes are not 1 either."""
    rng = generator(seed)
    made = [planes.new_level(*shape, rng) for shape in shapes]
    return [level._replace(time=level.time + 0.3 * torch.randn(level.time.shape, generator=rng))
            for level in made]  # fmt: skip


def tensors_of(some: list[planes.Level]) -> list[Tensor]:
    return [tensor for level in some for tensor in level]


def levels_of(tensors: list[Tensor]) -> list[planes.Level]:
    return [planes.Level(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]


def points(count: int) -> Tensor:
    """Points in the box and around it."""
    return 1.6 * torch.randn(count, 3, generator=generator(3))


def compare(place: str, some: list[planes.Level], count: int, time: float, beside: int = 0) -> None:
    given = [points(count), torch.randn(count, beside, generator=generator(4)), *tensors_of(some)]
    ours, exact = leaves(given, torch.float32), leaves(given, torch.float64)
    to_cube = planes._to_cube(BOX).tolist()
    there = [tensor.to(place) for tensor in ours]
    found = grids.lookup(*there[:2], time, to_cube, there[2:]).cpu()
    expected = planes.lookup_twin(levels_of(exact[2:]), exact[0], time, BOX, exact[1])
    assert_near(found, expected, TOLERANCE, "features")
    slope = torch.randn(expected.shape, generator=generator(5))
    slope[::3] = 0  # rows that nothing is to be learnt from
    found.backward(slope)
    expected.backward(slope.double())
    names = ["points", "beside", *(f"tensor {i}" for i in range(len(exact) - 2))]
    for name, one, other in zip(names, ours, exact, strict=True):
        assert_near(one.grad, other.grad, TOLERANCE, name)


@pytest.mark.parametrize("time", [-1.0, -0.37, 0.0, 1.0, 1.4])
def test_features_and_gradients_at_all_times(place: str, time: float) -> None:
    compare(place, levels((5, 4, 16)), 33, time)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 300])
def test_any_number_of_points(place: str, count: int) -> None:
    compare(place, levels((4, 3, 32), (9, 5, 16)), count, 0.2, beside=3)


def test_no_points_have_no_features_and_teach_nothing() -> None:
    own = leaves(tensors_of(levels((4, 3, 16))), torch.float32)
    to_cube = planes._to_cube(BOX).tolist()
    features = grids.lookup(torch.zeros(0, 3), torch.zeros(0, 2), 0.0, to_cube, own)
    assert features.shape == (0, 18)
    features.sum().backward()
    for tensor in own:
        assert tensor.grad is not None and not tensor.grad.any()


def test_the_smallest_grid(place: str) -> None:
    compare(place, levels((2, 2, 16)), 20, 0.5)


def test_points_that_need_no_gradient_get_none() -> None:
    own = leaves(tensors_of(levels((4, 3, 16))), torch.float32)
    given = points(20)
    to_cube = planes._to_cube(BOX).tolist()
    grids.lookup(given, torch.zeros(20, 0), 0.1, to_cube, own).sum().backward()
    assert given.grad is None
    assert own[0].grad is not None and own[0].grad.any()


def test_too_many_levels_are_refused() -> None:
    many = tensors_of(levels(*[(2, 2, 16)] * (MOST_LEVELS + 1)))
    with pytest.raises(ValueError, match="at most 8"):
        grids.lookup(points(2), torch.zeros(2, 0), 0.0, planes._to_cube(BOX).tolist(), many)


@pytest.mark.parametrize("shapes", [[(2, 2, 16)], [(5, 3, 32)], [(4, 7, 16), (9, 4, 16)]])
def test_penalties_and_their_gradients(place: str, shapes: list[tuple[int, int, int]]) -> None:
    given = tensors_of(levels(*shapes))
    ours, exact = leaves(given, torch.float32), leaves(given, torch.float64)
    found = grids.penalty((0.3, 0.7, 0.2), [tensor.to(place) for tensor in ours]).cpu()
    expected = planes.penalty_twin(levels_of(exact), 0.3, 0.7, 0.2)
    assert_near(found, expected, TOLERANCE, "value")
    (3 * found).backward()
    (3 * expected).backward()
    for i, (one, other) in enumerate(zip(ours, exact, strict=True)):
        assert_near(one.grad, other.grad, TOLERANCE, f"tensor {i}")
