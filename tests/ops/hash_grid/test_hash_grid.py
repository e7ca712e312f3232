"""Hash grids: the twin against the paper's formulas, the kernels against the twin."""

from __future__ import annotations

import math
from itertools import product
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from torch import Tensor

from gsdmsr_cli.ops import hash_grid
from gsdmsr_cli.ops.hash_grid import Levels

SHAPES = {
    2: Levels(((3, 2), (9, 7), (40, 33)), 64),
    3: Levels(((3, 2, 4), (5, 4, 3), (17, 12, 9)), 128),
    4: Levels(((2, 3, 2, 4), (5, 3, 2, 6)), 64),
}
"""Of each number of axes levels of both kinds, of which none is a cube."""

every_shape = pytest.mark.parametrize("axes", SHAPES)
every_form = pytest.mark.parametrize("look", [hash_grid.lookup, hash_grid.lookup_twin])


def table_of(levels: Levels, features: int, seed: int = 0) -> Tensor:
    return torch.randn(levels.offsets[-1], features, generator=generator(seed))


def points_of(count: int, axes: int, seed: int = 0) -> Tensor:
    """Return points in [-1.2, 1.2]^d, so that some lie outside of the grid."""
    return torch.rand(count, axes, generator=generator(seed + 1000)) * 2.4 - 1.2


def by_hand(levels: Levels, table: Tensor, point: list[float]) -> list[float]:
    """Return the features of a point as the paper says, in whole numbers of Python.

    A row is the number of a grid point, or the exclusive or of its coordinates times primes,
    modulo the number of rows (Eq. 4); the value is a sum over all grid points' hat functions.
    """
    primes, found = (1, 2654435761, 805459861, 3674653429), []
    for level, sizes in enumerate(levels.resolutions):
        total = [0.0] * table.shape[1]
        for place in product(*map(range, sizes)):
            share, number, mixed, stride = 1.0, 0, 0, 1
            for axis, size in enumerate(sizes):
                u = (min(max(point[axis], -1.0), 1.0) + 1) / 2 * (size - 1)
                share *= max(0.0, 1 - abs(u - place[axis]))
                number += place[axis] * stride
                mixed ^= place[axis] * primes[axis] % 2**32
                stride *= size
            row = levels.offsets[level] + (number if stride <= levels.most else mixed % levels.most)
            total = [t + share * float(v) for t, v in zip(total, table[row], strict=True)]
        found += total
    return found


@every_shape
@every_form
def test_features_are_those_of_the_paper(look: Any, axes: int) -> None:
    levels = SHAPES[axes]
    table, points = table_of(levels, 2), points_of(9, axes)
    expected = torch.tensor([by_hand(levels, table, point) for point in points.tolist()])
    torch.testing.assert_close(look(levels, table, points), expected, rtol=1e-4, atol=1e-5)


@every_shape
def test_twin_passes_gradcheck(axes: int) -> None:
    levels = SHAPES[axes]
    table, points = leaves([table_of(levels, 1), 0.7 * points_of(3, axes)], torch.float64)
    assert torch.autograd.gradcheck(
        lambda *given: hash_grid.lookup_twin(levels, *given), (table, points)
    )


@given(
    st.sampled_from(list(SHAPES)),
    st.sampled_from([1, 2, 3, 4, 8]),
    st.integers(1, 9) | st.just(333),
    st.integers(0, 99),
)
@settings(max_examples=40, deadline=None)
def test_lookup_matches_the_twin(axes: int, features: int, count: int, seed: int) -> None:
    levels = SHAPES[axes]
    start = [table_of(levels, features, seed), points_of(count, axes, seed)]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found, truth = hash_grid.lookup(levels, *ours), hash_grid.lookup_twin(levels, *exact)
    assert found.shape == (count, features * len(levels.resolutions))
    assert_near(found, truth, 1e-5, "features")
    weights = torch.randn(found.shape, generator=generator(seed))
    (found * weights).sum().backward()
    (truth * weights).sum().backward()
    for name, a, b in zip(("table", "points"), ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-4, f"gradient of the {name}")


@every_form
def test_no_points_have_no_features_and_give_no_gradient(look: Any) -> None:
    (table,) = leaves([table_of(SHAPES[3], 2)], torch.float32)
    features = look(SHAPES[3], table, torch.zeros(0, 3))
    assert features.shape == (0, 6)
    features.sum().backward()
    assert table.grad is not None and not table.grad.any()


def test_gradients_of_few_rows_belong_to_their_points() -> None:
    """Which only those rows go through; the others' are zero."""
    levels, live = SHAPES[3], [3, 40, 41, 199]
    start, slope = [table_of(levels, 2), points_of(200, 3)], torch.zeros(200, 6)
    slope[live] = torch.randn(4, 6, generator=generator(4))
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    hash_grid.lookup(levels, *ours).backward(slope)
    hash_grid.lookup_twin(levels, *exact).backward(slope.double())
    for a, b in zip(ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-4, "gradient")
    assert ours[1].grad is not None
    assert (ours[1].grad != 0).any(dim=1).nonzero().flatten().tolist() == live


def test_lookup_without_a_gradient_of_the_points() -> None:
    levels, points = SHAPES[3], points_of(7, 3)
    (ours,), (exact,) = (leaves([table_of(levels, 2)], t) for t in (torch.float32, torch.float64))
    hash_grid.lookup(levels, ours, points).sum().backward()
    hash_grid.lookup_twin(levels, exact, points.double()).sum().backward()
    assert points.grad is None
    assert_near(ours.grad, exact.grad, 1e-5, "gradient")


@every_form
def test_points_outside_are_clamped_and_get_no_gradient(look: Any) -> None:
    levels, table = SHAPES[3], table_of(SHAPES[3], 2)
    far = torch.tensor([[3.0, 0.2, -0.4], [0.1, -1e30, 0.3], [-9.0, 7.0, float("inf")]])
    outside, inside = far.abs() > 1, far.clamp(-1, 1)
    far.requires_grad_()
    features = look(levels, table, far)
    assert torch.equal(features, look(levels, table, inside))
    features.sum().backward()
    assert far.grad is not None
    assert not far.grad[outside].any() and far.grad[~outside].all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@every_form
def test_points_that_are_nowhere_add_nothing_where_nothing_is_to_be_learnt(
    look: Any, value: float
) -> None:
    """Few of many, so that rows without a gradient are not left out of the backward pass."""
    points, nowhere = points_of(40, 3), torch.tensor([3, 17, 38])
    points[nowhere, torch.tensor([0, 1, 2])] = value
    there = torch.ones(40, dtype=torch.bool).index_fill_(0, nowhere, False)
    results = []
    for rows in (slice(None), there):
        table, given = leaves([table_of(SHAPES[3], 2), points[rows]], torch.float32)
        features = look(SHAPES[3], table, given)
        features.backward(there[rows, None].float().expand_as(features))
        results.append((given.grad, features, table.grad))
    (d_points, found, shared), (d_finite, expected, alone) = results
    assert found.isfinite().all() and torch.equal(found[there], expected)
    assert torch.equal(d_points[there], d_finite) and not d_points[nowhere].any()
    assert torch.equal(shared, alone)


def test_values_that_are_not_finite_are_not_multiplied_by_no_gradient() -> None:
    """A level that is broken spoils what is read of it, and no other row's gradient."""
    levels, table = SHAPES[3], table_of(SHAPES[3], 2)
    table[: levels.offsets[1]] = math.nan
    ours, points = leaves([table, 0.8 * points_of(6, 3)], torch.float32)
    features = hash_grid.lookup(levels, ours, points)
    features.backward(torch.tensor([0.0, 0, 1, 1, 1, 1]).expand_as(features))
    for tensor in (ours, points):
        assert tensor.grad is not None and tensor.grad.isfinite().all() and tensor.grad.any()


@every_shape
def test_results_do_not_depend_on_the_number_of_threads(axes: int) -> None:
    levels = SHAPES[axes]
    start = [table_of(levels, 2), points_of(333, axes)]

    def compute() -> list[Tensor]:
        table, points = leaves(start, torch.float32)
        features = hash_grid.lookup(levels, table, points)
        features.square().sum().backward()
        return [features, *(t.grad for t in (table, points) if t.grad is not None)]

    assert len(compute()) == 3
    assert_same_on_threads(compute)


def test_resolutions_grow_geometrically() -> None:
    levels = hash_grid.new_levels((16, 16, 4), (2048, 2048, 32), 8, 19)
    assert levels.resolutions[0] == (16, 16, 4) and levels.resolutions[-1] == (2048, 2048, 32)
    for axis, growth in ((0, 2.0), (2, 8 ** (1 / 7))):
        sizes = [level[axis] for level in levels.resolutions]
        for i, size in enumerate(sizes):
            assert abs(size - sizes[0] * growth**i) <= 0.5
    assert hash_grid.new_levels((16, 8), (32, 64), 1, 4).resolutions == ((32, 64),)


def test_a_table_has_a_row_for_each_grid_point_up_to_the_most() -> None:
    levels = Levels(((4, 4, 4), (4, 4, 5), (3, 3, 3)), 64)
    assert [levels.is_hashed(level) for level in range(3)] == [False, True, False]
    assert levels.offsets == (0, 64, 128, 155)
    table = hash_grid.new_table(levels, 2, generator())
    assert table.shape == (155, 2)
    assert 0.9e-4 < float(table.abs().max()) <= 1e-4 and abs(float(table.mean())) < 2e-5
    hash_grid.check_table(levels, table, 2)
    for wrong in (table[1:], table[:, :1]):
        with pytest.raises(ValueError, match=r"not \(155, 2\), for a hash grid"):
            hash_grid.check_table(levels, wrong, 2)


@pytest.mark.parametrize(
    ("resolutions", "most"),
    [
        ((), 64),
        (((4, 4),) * 33, 64),
        (((4,),), 64),
        (((4, 4, 4, 4, 4),), 64),
        (((4, 1),), 64),
        (((4, 4), (4, 4, 4)), 64),
        (((4, 4),), 63),
        (((4, 4),), 0),
        (((4, 4),), 2**25),
    ],
)
def test_levels_that_no_kernel_serves_are_refused(resolutions: Any, most: int) -> None:
    with pytest.raises(ValueError, match="a hash grid has 1 to 32 levels, 2 to 4 axes with 2 or"):
        Levels(resolutions, most)


def test_points_of_other_coordinates_are_refused() -> None:
    with pytest.raises(ValueError, match="points of 3 coordinates in a grid of 2 axes"):
        hash_grid.lookup(SHAPES[2], table_of(SHAPES[2], 2), torch.zeros(1, 3))
