"""Every path by its name: which options it takes, and where its cameras stand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.paths import make_film, path_names
from gsdmsr_cli.paths.dolly import REACH, dolly
from gsdmsr_cli.paths.spiral import spiral
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.film import PathOptions
from gsdmsr_cli.scene.scene import Scene

ORIGIN, Z = np.zeros(3), np.array([0.0, 0.0, 1.0])
VIEWS = {"still": ("val/r_001",), "interpolate": ("test/r_000", "test/r_002", "test/r_001")}
SPLITS = {"train": 12, "val": 3, "test": 4}


@pytest.fixture(scope="module")
def scene(tiny_scene: Path) -> Scene:
    return read_scene(tiny_scene)


def camera_at(azimuth: float, elevation: float, distance: float = 4.0) -> Camera:
    flat = math.cos(elevation)
    where = [flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)]
    return Camera(look_at(distance * np.array(where), ORIGIN, Z), 50, 60, 11, 17, 40, 30)


def test_all_paths_are_found() -> None:
    made = {"orbit", "spiral", "dolly", "interpolate", "still"}
    assert set(path_names()) == made | SPLITS.keys()


@pytest.mark.parametrize("name", path_names())
def test_every_path_is_a_film_of_one_size_with_moments(scene: Scene, name: str) -> None:
    asked = PathOptions(None if name in SPLITS else 7, VIEWS.get(name, ()))
    film = make_film(scene, name, asked)
    assert film.name == name
    assert len(film.shots) == SPLITS.get(name, 7)
    assert film.fps == (10 if name in SPLITS else 30)
    for shot in film.shots:
        assert 0 <= shot.time <= 1
        assert (shot.camera.width, shot.camera.height) == (48, 48)
        rotation = shot.camera.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert shot.camera.translation[2] > 0  # the scene's middle lies ahead
        assert (shot.view is not None) == (name in SPLITS)


@pytest.mark.parametrize("name", sorted(set(path_names()) - SPLITS.keys()))
def test_made_paths_have_a_length_of_their_own(scene: Scene, name: str) -> None:
    film = make_film(scene, name, PathOptions(views=VIEWS.get(name, ())))
    assert len(film.shots) == (180 if name == "spiral" else 120)
    times = [shot.time for shot in film.shots]
    if name != "interpolate":
        assert times[0] == 0 and times[-1] == 1 and times == sorted(times)
    assert len(make_film(scene, name, PathOptions(1, VIEWS.get(name, ()))).shots) == 1


@pytest.mark.parametrize("name", path_names())
def test_time_can_stand_still_on_every_path(scene: Scene, name: str) -> None:
    asked = PathOptions(None if name in SPLITS else 5, VIEWS.get(name, ()))
    moving, frozen = (make_film(scene, name, asked, time=time, fps=7.0) for time in (None, 0.5))
    assert {shot.time for shot in frozen.shots} == {0.5} and frozen.fps == 7
    for one, other in zip(moving.shots, frozen.shots, strict=True):
        assert one.camera is other.camera or np.array_equal(
            one.camera.world_to_camera, other.camera.world_to_camera
        )
        assert other.view is None or one.time == 0.5  # no picture shows the view at that moment


def test_views_come_in_the_order_of_time(scene: Scene) -> None:
    turned = replace(scene, views=scene.views[::-1])
    times = [shot.time for shot in make_film(turned, "train", PathOptions()).shots]
    assert times == sorted(times)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("orbt", PathOptions(), "unknown path 'orbt'; did you mean 'orbit'"),
        ("_smooth", PathOptions(), "unknown path '_smooth'"),
        ("test", PathOptions(3), "--frames is not for --path test"),
        ("orbit", PathOptions(views=("test/r_000",)), "--view is not for --path orbit; drop it"),
        ("still", PathOptions(), "found 0 --view, give one"),
        ("still", PathOptions(views=("test/r_000", "test/r_001")), "found 2 --view"),
        ("interpolate", PathOptions(views=("test/r_000",)), "two or more views; found 1"),
        ("dolly", PathOptions(views=("test/r_000", "test/r_001")), "begins at one view"),
        ("still", PathOptions(views=("r_000",)), "several views are called 'r_000'"),
        ("still", PathOptions(views=("test/r_01",)), "no view is called 'test/r_01'"),
        ("a.json", PathOptions(views=("test/r_000",)), "--view is not for --path a.json"),
    ],
)
def test_what_a_path_does_not_take_is_refused(
    scene: Scene, name: str, options: PathOptions, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        make_film(scene, name, options)


@pytest.mark.parametrize("name", ["test", "val"])
def test_a_split_without_frames_is_told(scene: Scene, name: str) -> None:
    bare = replace(scene, views=tuple(view for view in scene.views if view.split == "train"))
    with pytest.raises(DataError, match=f"split '{name}' has no frames; found train 12"):
        make_film(bare, name, PathOptions())


def test_a_still_camera_is_that_of_its_view(scene: Scene) -> None:
    film = make_film(scene, "still", PathOptions(3, ("val/r_001",)))
    view = scene.split("val")[1]
    assert all(shot.camera is view.camera for shot in film.shots)


def test_a_dolly_slides_along_its_line_of_sight() -> None:
    first, *_, last = cameras = dolly(camera_at(0.3, 0.4), 1.0, 9)
    ways = [np.linalg.norm(c.centre - first.centre) for c in cameras]
    assert ways[-1] == pytest.approx(REACH * 4) and ways[4] == pytest.approx(REACH * 2)
    assert ways == sorted(ways) and ways[1] < 0.5 * REACH * 4 / 8  # slow at first
    assert np.array_equal(first.rotation, last.rotation)
    assert last.translation == pytest.approx([0, 0, 4 - REACH * 4])


def test_a_dolly_of_a_camera_that_looks_away_goes_as_far_as_the_scene_is_large() -> None:
    pose = look_at(np.array([4.0, 0, 0]), np.array([8.0, 0, 0]), Z)
    last = dolly(replace(camera_at(0, 0), world_to_camera=pose), 1.5, 4)[-1]
    assert last.centre == pytest.approx([4 + REACH * 1.5, 0, 0])


def test_a_spiral_round_the_scene_climbs_in_two_turns() -> None:
    cameras = [camera_at(0.7 * i, 0.1 + 0.05 * i) for i in range(21)]
    around = spiral(cameras, ORIGIN, 41)
    heights = [math.asin(camera.centre[2] / 4) for camera in around]
    assert heights[0] == pytest.approx(0.2) and heights[-1] == pytest.approx(1.0)
    assert np.diff(heights) == pytest.approx(np.full(40, 0.02))
    azimuths = np.unwrap([math.atan2(*camera.centre[1::-1]) for camera in around])
    assert azimuths[-1] - azimuths[0] == pytest.approx(4 * math.pi)
    for camera in around:
        assert np.linalg.norm(camera.centre) == pytest.approx(4)
        assert camera.translation == pytest.approx([0, 0, 4], abs=1e-9)


def test_a_spiral_before_the_scene_opens_and_closes() -> None:
    grid = [camera_at(0.1 * i, 0.1 * j) for i in range(-3, 4) for j in range(-3, 4)]
    around = spiral(grid, ORIGIN, 41)
    first, middle, last = around[0].centre / 4, around[20].centre / 4, around[-1].centre / 4
    assert first == pytest.approx([1, 0, 0], abs=0.02) and last == pytest.approx(first)
    angles = [math.acos(min(1, camera.centre @ first / 4)) for camera in around]
    assert max(angles) == pytest.approx(angles[20]) and 0.3 < angles[20] < 0.45
    assert middle[0] > 0.85
    sides = {(camera.centre[1] > 0, camera.centre[2] > 0) for camera in around[5:36]}
    assert len(sides) == 4  # it goes round


def test_one_camera_alone_makes_a_spiral_too() -> None:
    for camera in spiral([camera_at(0.2, 0.3)], ORIGIN, 4):
        assert np.isfinite(camera.world_to_camera).all()
