"""Which way is up in a capture's world, and which views are for testing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsdmsr_cli.capture.normalize import is_test, upright


def cameras(turn: np.ndarray, up: np.ndarray, count: int = 7) -> np.ndarray:
    """Rotations of cameras that look all round, upright in a world that was turned afterwards."""
    rotations = []
    for angle in 2 * np.pi * np.arange(count) / count:
        ahead = np.array([np.cos(angle), np.sin(angle), 0.0])
        rotations.append(np.stack([np.cross(ahead, up), -up, ahead]) @ turn.T)
    return np.stack(rotations)


@pytest.mark.parametrize("seed", range(4))
def test_up_is_where_the_tops_of_the_pictures_point(seed: int) -> None:
    """Whatever way the world was turned; the first camera's right comes to lie along x."""
    turn = Rotation.random(random_state=seed).as_matrix()
    rotations = cameras(turn, np.array([0.0, 0.0, 1.0]))
    found = upright(rotations)
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found) == pytest.approx(1.0)
    np.testing.assert_allclose(found @ turn @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found @ rotations[0, 0], [1, 0, 0], atol=1e-12)


def test_cameras_without_a_common_up_stay_as_they_are() -> None:
    opposite = np.stack([np.eye(3), np.diag([-1.0, -1.0, 1.0])])
    np.testing.assert_array_equal(upright(opposite), np.eye(3))


def test_a_first_camera_that_looks_along_its_side_turns_by_where_it_looks() -> None:
    """Its right is up on average: what lies ahead of it takes the place of that."""
    first = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    second = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, -4.0], [1.0, 0.0, 0.0]])
    found = upright(np.stack([first, second]))
    np.testing.assert_allclose(found @ [0, 0, 1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(found @ [0, 1, 0], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("every", "expected"), [(0, []), (1, [0, 1, 2, 3, 4]), (2, [1, 3]), (4, [2]), (5, [2])]
)
def test_test_views_lie_in_the_middle_of_their_intervals(every: int, expected: list[int]) -> None:
    assert [i for i in range(5) if is_test(i, every)] == expected
