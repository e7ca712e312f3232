"""Farthest-point sampling: what going through all points for each one chooses, in any order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsdmsr_cli.ops.spread.cpu import choose_spread


def chosen(
    points: NDArray[np.float64], first: int, count: int, squares: NDArray[np.float64] | None = None
) -> NDArray[np.int64]:
    rows = np.empty(count, np.int64)
    choose_spread(points, np.ones(len(points)) if squares is None else squares, first, rows)
    return rows


def one_by_one(
    points: NDArray[np.float64], first: int, count: int, squares: NDArray[np.float64] | float = 1.0
) -> NDArray[np.int64]:
    """Gonzalez' rule as it is said, of weighted distances; of equally far points the first."""
    rows, away = [first], np.full(len(points), np.inf)
    while len(rows) < count:
        away = np.minimum(away, squares * np.square(points - points[rows[-1]]).sum(axis=1))
        rows.append(int(away.argmax()))
    return np.array(rows)


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 200), st.integers(1, 40), st.booleans(), st.booleans(), st.integers(0, 2**31))
def test_it_chooses_what_the_rule_says(
    size: int, count: int, whole: bool, weighted: bool, seed: int
) -> None:
    """Also among points at whole numbers, of which many coincide and are equally far."""
    rng = np.random.default_rng(seed)
    points = rng.integers(-2, 3, (size, 3)).astype(float) if whole else rng.normal(size=(size, 3))
    first = int(rng.integers(size))
    squares = rng.integers(1, 17, size).astype(float) if weighted else np.ones(size)
    found = chosen(points, first, count, squares)
    assert found.tolist() == one_by_one(points, first, count, squares).tolist()


@pytest.mark.parametrize("sort", [False, True])
def test_it_passes_over_far_points_where_neighbours_follow_each_other(sort: bool) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(3000, 3))
    points = points[np.lexsort(np.floor(points.T))] if sort else points
    squares = rng.uniform(0.1, 9.0, 3000)
    assert chosen(points, 5, 200).tolist() == one_by_one(points, 5, 200).tolist()
    assert chosen(points, 5, 200, squares).tolist() == one_by_one(points, 5, 200, squares).tolist()
