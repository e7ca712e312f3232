"""The nearest points: what SciPy finds, whatever is guessed or remembered."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import assert_same_on_threads, generator
from scipy.spatial import cKDTree
from skinning_checks import guesses
from torch import Tensor

from gsdmsr_cli.ops.nearest import Nearest, nearest_points


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 200), st.integers(1, 70), st.integers(1, 9), st.integers(0, 2**31))
def test_the_nearest_points_are_what_scipy_finds_whatever_the_guess(
    count: int, size: int, kept: int, seed: int
) -> None:
    rng = generator(seed)
    queries, points = torch.randn(count, 3, generator=rng), torch.randn(size, 3, generator=rng)
    kept = min(kept, size)
    exact = cKDTree(points.double()).query(queries.double(), k=kept)[0].reshape(count, kept)
    found = nearest_points(queries, points, guesses(count, kept))
    assert all(row == sorted(set(row)) and len(row) == kept for row in found.tolist())
    near_by = queries + 0.1 * torch.randn(count, 3, generator=rng)
    guess = nearest_points(near_by, points, guesses(count, kept))
    for other in (found, guess, torch.randint(size, (count, kept), generator=rng).int()):
        assert torch.equal(nearest_points(queries, points, other), found)
    twin = nearest_points(queries.double(), points.double(), guess)
    for near in (found, twin):
        distances = (queries[:, None] - points[near.long()]).norm(dim=2).sort(dim=1).values.double()
        torch.testing.assert_close(distances, torch.from_numpy(exact), rtol=1e-5, atol=1e-5)


def test_of_equally_near_points_the_first_are_found() -> None:
    points = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]] * 9)
    found = nearest_points(torch.zeros(2, 3), points, guesses(2, 3))
    assert found.tolist() == [[0, 1, 2]] * 2


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 200), st.integers(1, 70), st.integers(1, 9), st.integers(-6, 0),
    st.integers(0, 2**31),
)  # fmt: skip
def test_a_search_that_is_repeated_finds_what_a_new_one_finds(
    count: int, size: int, kept: int, power: int, seed: int
) -> None:
    """After moves of all sizes, of queries and of points, of which some are where another is."""
    rng, kept = generator(seed), min(kept, size)
    queries, points = torch.randn(count, 3, generator=rng), torch.randn(size, 3, generator=rng)
    points[size // 2 :: 3] = points[0].clone()
    search = Nearest(kept)
    for k in range(8):
        queries = queries + 10.0**power * torch.randn(count, 3, generator=rng)
        if k % 2:
            points = points + 10.0**power * torch.randn(size, 3, generator=rng)
        expected = nearest_points(queries, points, guesses(count, kept))
        assert torch.equal(search.find(queries, points), expected)


def test_what_is_remembered_does_not_wear_off() -> None:
    """Points that drift along far from the origin, by steps that a sum in float32 would lose."""
    rng = generator(2)
    queries, points = torch.randn(300, 3, generator=rng), torch.randn(40, 3, generator=rng)
    step = 3e-6 * torch.randn(40, 3, generator=rng)
    search = Nearest(4)
    search.find(queries, points + 1000)
    for k in range(400):
        moved = points + k * step
        found = search.find(queries, moved)
    assert torch.equal(found, nearest_points(queries, moved, guesses(300, 4)))


def test_a_result_stays_as_it_is_when_the_search_goes_on() -> None:
    rng = generator(1)
    queries, points = torch.randn(50, 3, generator=rng), torch.randn(30, 3, generator=rng)
    search = Nearest(3)
    first = search.find(queries, points)
    kept = first.clone()
    assert not torch.equal(search.find(-queries, points), kept)
    assert torch.equal(first, kept)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30])
def test_a_place_that_is_nowhere_is_searched_from_again_once_it_is_back(value: float) -> None:
    rng = generator(1)
    queries, points = torch.randn(50, 3, generator=rng), torch.randn(30, 3, generator=rng)
    search = Nearest(3)
    expected = search.find(queries, points)
    for moved in (queries, points):
        before = moved[7].clone()
        moved[7, 1] = value
        found = search.find(queries, points)
        assert found.min() >= 0 and found.max() < 30
        moved[7] = before
        assert torch.equal(search.find(queries, points), expected)


def test_other_numbers_of_queries_and_points_begin_anew() -> None:
    rng, search = generator(1), Nearest(3)
    for count, size in ((50, 30), (20, 30), (20, 70), (0, 70), (60, 3)):
        queries, points = torch.randn(count, 3, generator=rng), torch.randn(size, 3, generator=rng)
        expected = nearest_points(queries, points, guesses(count, 3))
        assert torch.equal(search.find(queries, points), expected)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    def compute() -> list[Tensor]:
        rng, search = generator(4), Nearest(8)
        queries, points = torch.randn(500, 3, generator=rng), torch.randn(40, 3, generator=rng)
        steps = 0.01 * torch.randn(5, 500, 3, generator=rng)
        return [search.find(queries + step, points) for step in steps]

    assert_same_on_threads(compute)
