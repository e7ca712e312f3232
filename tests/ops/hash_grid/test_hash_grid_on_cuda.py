"""Lookups of hash grids on CUDA kernels are their plain torch twins in float64."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, generator, leaves

from gsdmsr_cli.backends.cuda.compiler import MOST_HASH_LEVELS
from gsdmsr_cli.ops import hash_grid
from gsdmsr_cli.ops.hash_grid import Levels, cuda

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")


def compare(place: str, levels: Levels, features: int, count: int) -> None:
    rng = generator(3)
    start = [
        torch.randn(levels.offsets[-1], features, generator=rng),
        torch.rand(count, levels.axes, generator=rng) * 2.4 - 1.2,
    ]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = cuda.lookup(levels, *(tensor.to(place) for tensor in ours)).cpu()
    expected = hash_grid.lookup_twin(levels, *exact)
    assert_near(found, expected, 2e-5, "features")
    slope = torch.randn(expected.shape, generator=generator(5))
    slope[::3] = 0  # rows that nothing is to be learnt from
    found.backward(slope)
    expected.backward(slope.double())
    for name, one, other in zip(("table", "points"), ours, exact, strict=True):
        assert_near(one.grad, other.grad, 1e-4, f"gradient of the {name}")


@pytest.mark.parametrize("features", [1, 2, 8])
@pytest.mark.parametrize(
    "levels",
    [
        Levels(((3, 2), (9, 7), (40, 33)), 64),
        Levels(((3, 2, 4), (5, 4, 3), (17, 12, 9)), 128),
        Levels(((2, 3, 2, 4), (5, 3, 2, 6)), 64),
        Levels(((2, 2, 2),) * MOST_HASH_LEVELS, 8),
    ],
    ids=lambda levels: f"{levels.axes} axes, {len(levels.resolutions)} levels",
)
def test_features_and_gradients(place: str, levels: Levels, features: int) -> None:
    compare(place, levels, features, 33)


@pytest.mark.parametrize("count", [1, 255, 256, 257])
def test_any_number_of_points(place: str, count: int) -> None:
    compare(place, Levels(((5, 4, 3), (30, 40, 50)), 256), 2, count)


def test_no_points_have_no_features_and_teach_nothing() -> None:
    levels = Levels(((5, 4, 3),), 64)
    (table,) = leaves([torch.randn(60, 2)], torch.float32)
    features = cuda.lookup(levels, table, torch.zeros(0, 3))
    assert features.shape == (0, 2)
    features.sum().backward()
    assert table.grad is not None and not table.grad.any()


def test_points_outside_are_clamped_and_get_no_gradient(place: str) -> None:
    levels = Levels(((5, 4, 3), (17, 12, 9)), 128)
    table = torch.randn(levels.offsets[-1], 2, generator=generator(1))
    points = torch.tensor([[3.0, 0.2, -0.4], [0.1, -1e30, 0.3], [-9.0, 7.0, float("nan")]])
    given = points.clone().to(place).requires_grad_()
    features = cuda.lookup(levels, table.to(place), given)
    inside = points.clamp(-1, 1).nan_to_num(-1.0)
    assert torch.equal(features, cuda.lookup(levels, table.to(place), inside.to(place)))
    features.sum().backward()
    assert given.grad is not None
    within = points.abs() <= 1
    assert given.grad.cpu()[within].all() and not given.grad.cpu()[~within].any()
