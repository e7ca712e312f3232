"""Which rows belong to a view: its own, its camera's, those beside it on the path, or none."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gsdmsr_cli.model.view_rows import ViewRows, rows_of
from gsdmsr_cli.scene.camera import Camera, look_at

UP = np.array([0.0, 0.0, 1.0])


def camera_at(azimuth: float, distance: float = 4.0) -> Camera:
    centre = distance * np.array([math.cos(azimuth), math.sin(azimuth), 0.3])
    return Camera(look_at(centre, np.zeros(3), UP), 50.0, 50.0, 20.0, 15.0, 40, 30)


def walk(count: int = 11) -> list[tuple[Camera, float]]:
    """Return views from 0 to 0.2 rad."""
    return [(camera_at(0.2 * t), float(t)) for t in np.linspace(0, 1, count)]


def teleporting() -> list[tuple[Camera, float]]:
    return [(camera_at(2.4 * i), i / 10) for i in range(11)]


def rig() -> list[tuple[Camera, float]]:
    return [(camera_at(0.1 * c), t / 4) for t in range(5) for c in range(3)]


@pytest.mark.parametrize("views", [walk(), teleporting()])
def test_a_train_view_has_its_own_row(views: list[tuple[Camera, float]]) -> None:
    rows = rows_of(views, "auto", 1.0, 4)
    assert rows.count == len(views) and not rows.per_camera
    for i, (camera, time) in enumerate(views):
        assert rows.weights(camera.resized(20, 15), time) == ((i, 1.0),)


def test_between_two_views_of_a_path_it_is_linear_in_time() -> None:
    rows = rows_of(walk(), "auto", 1.0, 1)
    (first, less), (second, more) = rows.weights(camera_at(0.066), 0.33)
    assert (first, second) == (3, 4)
    assert less == pytest.approx(0.7) and more == pytest.approx(0.3)


def test_several_neighbours_give_the_line_through_them() -> None:
    rows = rows_of(walk(), "auto", 1.0, 3)
    weights = rows.weights(camera_at(0.066), 0.33)
    assert {row for row, _ in weights} == {1, 2, 3, 4, 5, 6}
    line = sum(share * (5 - 2 * rows.times[row]) for row, share in weights)
    assert line == pytest.approx(5 - 2 * 0.33)
    assert sum(share**2 for _, share in weights) < 0.25, "noise becomes less than between two"


def test_beyond_the_end_of_a_path_there_is_no_line() -> None:
    weights = rows_of(walk(), "auto", 1.0, 2).weights(camera_at(0.202), 1.01)
    assert dict(weights) == {9: 0.5, 10: 0.5}


@pytest.mark.parametrize(("views", "camera", "time"), [
    (teleporting(), camera_at(2.4 * 3.5), 0.35),
    (walk(), camera_at(1.0), 0.5),
    (walk(), camera_at(0.1, 6.0), 0.5),
    (walk(), camera_at(0.2), 0.0),
    (rig(), camera_at(0.05), 0.25),
    ([], camera_at(0.0), 0.0),
])  # fmt: skip
def test_what_is_nowhere_near_has_none(
    views: list[tuple[Camera, float]], camera: Camera, time: float
) -> None:
    """Cameras that jump, one off the path, one there at another time, a rig's unseen camera."""
    if views:
        assert rows_of(views, "auto", 1.0, 2).weights(camera, time) == ()


def test_a_rigs_cameras_have_a_row_each_at_all_times() -> None:
    rows = rows_of(rig(), "auto", 1.0, 1)
    assert rows.count == 3 and rows.per_camera
    assert rows.weights(camera_at(0.1), 0.77) == ((1, 1.0),)
    assert rows.centres().shape == (3, 3)
    assert len(rows.poses) == 3  # and not one for each of the pictures
    assert rows_of(rig(), "frame", 1.0, 1).count == 15


def test_a_camera_of_an_earlier_version_has_its_row_by_any_of_its_views() -> None:
    views = rig()
    times = np.array([time for _, time in views])
    poses = np.stack([camera.world_to_camera for camera, _ in views])
    numbers = rows_of(views, "auto", 1.0, 1)
    each = np.array([numbers.own(*view) for view in views])
    earlier = ViewRows(times, poses, each, 1.0)
    assert earlier.per_camera
    for camera in (camera_at(0.1), camera_at(0.05)):
        assert earlier.weights(camera, 0.77) == numbers.weights(camera, 0.77)


def test_one_fixed_camera_is_no_rig() -> None:
    views = [(camera_at(0.0), i / 5) for i in range(6)]
    assert rows_of(views, "auto", 1.0, 1).count == 6
    assert rows_of(views, "camera", 1.0, 1).count == 1


def test_of_two_cameras_that_take_turns_the_same_one_is_the_neighbour() -> None:
    """As in Nerfies' captures: the test view is of the other camera at the time of a train view."""
    views = [(camera_at(0.002 * i + 0.05 * (i % 2)), i / 10) for i in range(11)]
    rows = rows_of(views, "auto", 4.0, 1)
    weights = rows.weights(camera_at(0.002 * 4 + 0.05), 0.4)
    assert {row for row, _ in weights} == {3, 5}
