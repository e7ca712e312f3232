"""Camera paths: where an orbit goes round, what it looks at and which way is up."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.paths._around import STEEPEST, common_up
from gsdmsr_cli.paths.orbit import orbit
from gsdmsr_cli.scene.camera import Camera, look_at

Z = np.array([0.0, 0.0, 1.0])
ORIGIN = np.zeros(3)


def camera_at(azimuth: float, elevation: float, distance: float = 4.0) -> Camera:
    """Return a camera that faces the origin with z up, its principal point off the middle."""
    flat = math.cos(elevation)
    direction = [flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)]
    pose = look_at(distance * np.array(direction), ORIGIN, Z)
    return Camera(pose, 50.0, 60.0, 11.0, 17.0, 40, 30)


def dome(elevations: list[float], distance: float = 4.0) -> list[Camera]:
    return [camera_at(0.7 + 2.4 * i, e, distance) for i, e in enumerate(elevations)]


def turned(camera: Camera, rotation: np.ndarray, shift: np.ndarray) -> Camera:
    """Return the camera after the world has been turned and shifted: x' = rotation x + shift."""
    pose = camera.world_to_camera.copy()
    pose[:3, :3] = camera.rotation @ rotation.T
    pose[:3, 3] = camera.translation - pose[:3, :3] @ shift
    return replace(camera, world_to_camera=pose)


def assert_faces(camera: Camera, centre: np.ndarray) -> None:
    """Hold the pose to a rigid one whose axis of sight goes through ``centre``."""
    rotation = camera.rotation
    assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    x, y, z = rotation @ centre + camera.translation
    assert abs(x) < 1e-9 and abs(y) < 1e-9 and z > 0


@given(st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=9), st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_an_orbit_has_the_mean_distance_and_elevation(elevations: list[float], count: int) -> None:
    cameras = [*dome(elevations, 3.0), *dome(elevations, 5.0)]
    around = orbit(cameras, ORIGIN, count)
    assert len(around) == count
    for camera in around:
        assert_faces(camera, ORIGIN)
        assert np.linalg.norm(camera.centre) == pytest.approx(4.0)
        assert camera.centre[2] == pytest.approx(4 * math.sin(np.mean(elevations)), abs=1e-6)
        assert camera.rotation[1] @ Z < 0  # y points down


def test_an_orbit_goes_round_once_in_even_steps_from_above_the_first_camera() -> None:
    cameras = dome([0.2, 0.6, 1.0])
    around = orbit(cameras, ORIGIN, 8)
    angles = np.unwrap([math.atan2(*camera.centre[1::-1]) for camera in around])
    assert angles[0] == pytest.approx(0.7)
    assert np.diff(angles) == pytest.approx(np.full(7, 2 * math.pi / 8))


def test_an_orbit_takes_lenses_and_size_from_the_first_camera() -> None:
    first = camera_at(0.1, 0.2)
    wide = replace(camera_at(2.0, 0.2), fx=9.0, fy=9.0, width=100, height=100)
    for camera in orbit([first, wide], ORIGIN, 3):
        assert (camera.fx, camera.fy, camera.width, camera.height) == (50.0, 60.0, 40, 30)
        assert (camera.cx, camera.cy) == (20.0, 15.0)  # the middle: the scene is in the middle


@given(st.tuples(*[st.floats(-1, 1)] * 4), st.tuples(*[st.floats(-5, 5)] * 3))
@settings(max_examples=30, deadline=None)
def test_an_orbit_turns_and_moves_with_the_world(
    quat: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    rotation = quat_to_rotmat(torch.tensor([quat], dtype=torch.float64))[0].numpy()
    cameras = dome([0.1, 0.5, 0.9, 0.3, 0.4])
    moved = [turned(camera, rotation, np.array(shift)) for camera in cameras]
    expected = [turned(c, rotation, np.array(shift)) for c in orbit(cameras, ORIGIN, 5)]
    for found, camera in zip(orbit(moved, np.array(shift), 5), expected, strict=True):
        assert np.allclose(found.world_to_camera, camera.world_to_camera, atol=1e-6)


@pytest.mark.parametrize("elevation", [math.pi / 2 - 1e-9, -math.pi / 2 + 1e-9])
def test_an_orbit_of_cameras_straight_above_keeps_off_the_pole(elevation: float) -> None:
    up = np.array([0.3, 1.0, 0.0])
    pose = look_at(np.array([0.0, 0.0, math.copysign(4, elevation)]), ORIGIN, up)
    cameras = [replace(c, world_to_camera=pose) for c in dome([0.0])] + dome([elevation] * 9)
    for camera in orbit(cameras, ORIGIN, 4):
        assert_faces(camera, ORIGIN)
        height = abs(camera.centre @ common_up(cameras)) / np.linalg.norm(camera.centre)
        assert height <= math.sin(STEEPEST) + 1e-6


def test_cameras_in_the_middle_make_an_orbit_of_some_size() -> None:
    pose = look_at(ORIGIN, np.array([1.0, 0.0, 0.0]), Z)
    centred = replace(camera_at(0, 0), world_to_camera=pose)
    for camera in orbit([centred], ORIGIN, 3):
        assert_faces(camera, ORIGIN)


@pytest.mark.parametrize("elevations", [[1.2] * 5, [0.1, 0.8, 1.4, 0.5], [-0.5, -1.0, 0.1, -0.7]])
def test_level_cameras_agree_on_what_is_up(elevations: list[float]) -> None:
    """Though they look up or down, so that the mean of their own ups is no vertical."""
    assert common_up(dome(elevations)) == pytest.approx(Z, abs=1e-6)


def test_a_single_camera_knows_no_up_but_its_own() -> None:
    cameras = dome([0.3])
    assert common_up(cameras) == pytest.approx(-cameras[0].rotation[1])


def test_opposite_ups_leave_z() -> None:
    one = camera_at(0.4, 0.0)
    upside_down = one.world_to_camera.copy()
    upside_down[:2] *= -1
    assert np.array_equal(common_up([one, replace(one, world_to_camera=upside_down)]), Z)
