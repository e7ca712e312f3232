"""Distances to the nearest points, against SciPy's k-d tree and by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from gsdmsr_cli.ops.neighbours.cpu import LEAF, mean_squares


def by_scipy(points: np.ndarray, count: int) -> np.ndarray:
    distances = cKDTree(points).query(points, k=count + 1)[0][:, 1:]
    return np.square(distances).mean(axis=1)


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 300), st.integers(1, 5), st.integers(0, 2**32 - 1), st.sampled_from("uzcd"))
def test_it_is_what_scipy_finds(size: int, count: int, seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(size, 3))
    if kind == "z":  # in a plane
        points[:, 2] = 7.0
    elif kind == "c":  # clusters of very different density, far from the origin
        points = points * 10.0 ** rng.integers(-3, 4, (size, 1)) + 1000.0
    elif kind == "d":  # many at one place
        points = points.round()
    count = min(count, size - 1)
    expected = by_scipy(points, count)
    np.testing.assert_allclose(mean_squares(points, count), expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [LEAF - 1, LEAF, LEAF + 1, 2 * LEAF, 2 * LEAF + 1, 4 * LEAF - 1])
def test_leaves_that_are_just_full(size: int) -> None:
    points = np.random.default_rng(size).random((size, 3))
    np.testing.assert_allclose(mean_squares(points, 3), by_scipy(points, 3), rtol=1e-9)


def test_points_at_one_place_have_no_distance() -> None:
    assert (mean_squares(np.ones((100, 3)), 3) == 0).all()


def test_a_line_by_hand() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0], [100, 0, 0]])
    assert mean_squares(line, 2).tolist() == [
        5.0,
        2.5,
        (4 + 9) / 2,
        (16 + 36) / 2,
        (93**2 + 97**2) / 2,
    ]
