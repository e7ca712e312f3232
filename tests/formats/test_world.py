"""Normalised worlds of captures with and without points: where they lie, and how large they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.formats._world import DISTANCE, NEAREST, World, normalize
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.scene import View

UP = np.array([0.0, 0.0, 1.0])


def view_at(centre: np.ndarray, target: np.ndarray) -> View:
    camera = Camera(look_at(centre, target, UP), 100.0, 100.0, 50.0, 40.0, 100, 80)
    return View("v", camera, 0.0, "train", Path())


def ring(target: np.ndarray, radius: float, count: int = 12) -> list[View]:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    offsets = radius * np.stack([np.cos(angles), np.sin(angles), 0.3 + 0 * angles], 1)
    return [view_at(target + offset, target) for offset in offsets]


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    local = points @ camera.rotation.T + camera.translation
    focal, middle = [camera.fx, camera.fy], [camera.cx, camera.cy]
    return local[:, :2] / local[:, 2:] * focal + middle


def depths(views: tuple[View, ...], points: np.ndarray) -> np.ndarray:
    return np.stack([points @ v.camera.rotation[2] + v.camera.translation[2] for v in views])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 500.0])
def test_pictures_stay_what_they_are(scale: float) -> None:
    target = scale * np.array([10.0, -20.0, 5.0])
    points = target + scale * np.random.default_rng(0).normal(size=(300, 3)) * 0.2
    views = ring(target, 2 * scale)
    world = normalize(views, points)
    normalized = world.views(views)
    for before, after in zip(views, normalized, strict=True):
        expected = project(before.camera, points)
        np.testing.assert_allclose(project(after.camera, world.points(points)), expected, atol=0.01)
        np.testing.assert_allclose(after.camera.rotation, before.camera.rotation)
    assert np.median(depths(normalized, world.points(points))) == pytest.approx(DISTANCE, rel=1e-3)
    assert np.abs(world.points(points)).max(axis=1) == pytest.approx(
        np.abs(world.points(points)).max(axis=1).clip(0, 3 * world.bound)
    )
    assert (np.abs(world.points(points)).max(axis=1) <= world.bound).mean() > 0.97


def along(depths: list[float]) -> tuple[list[View], np.ndarray]:
    """Return a camera at the origin that looks along y, and points straight ahead of it."""
    points = np.zeros((len(depths), 3))
    points[:, 1] = depths
    return [view_at(np.zeros(3), np.array([0, 1.0, 0]))], points


def test_the_world_of_points_at_known_depths() -> None:
    """From 2 to 6 by 0.04: of 101 sorted values the median is the 51st, 2 % lie below the third.

    Distances from the middle are 0, 0.04, 0.04, 0.08, 0.08 and so on; 98 % are up to the 99th.
    """
    world = normalize(*along([2 + 0.04 * i for i in range(101)]))
    assert world.scale == pytest.approx(DISTANCE / 4, rel=1e-9)
    np.testing.assert_allclose(world.centre, [0, 4, 0], atol=1e-9)
    assert world.bound == pytest.approx(49 * 0.04 * DISTANCE / 4, rel=1e-9)


def test_the_nearest_but_strays_come_no_nearer_than_they_may() -> None:
    world = normalize(*along([0.01] * 2 + [0.5] * 5 + [40.0] * 94))
    assert world.scale == pytest.approx(NEAREST / 0.5, rel=1e-9)  # not DISTANCE / 40


def test_strays_move_nothing() -> None:
    target = np.array([3.0, 2.0, 1.0])
    points = target + np.random.default_rng(1).normal(size=(1000, 3)) * 0.2
    clean = normalize(ring(target, 2.0), points)
    points[:5] = 1e6
    soiled = normalize(ring(target, 2.0), points)
    assert soiled.scale == pytest.approx(clean.scale, rel=0.02)
    assert soiled.bound == pytest.approx(clean.bound, rel=0.1)
    np.testing.assert_allclose(soiled.centre, clean.centre, atol=0.02)


def test_near_things_are_not_cut_off() -> None:
    """Half of the points lie at a hundredth of the depth of the others."""
    views = [view_at(np.array([0.1 * i, 0, 0]), np.array([0.1 * i, 1.0, 0])) for i in range(5)]
    rng = np.random.default_rng(2)
    near = np.array([0.2, 1.0, 0]) + 0.05 * rng.normal(size=(100, 3))
    far = np.array([0.2, 100.0, 0]) + rng.normal(size=(300, 3))
    points = np.concatenate([near, far])
    world = normalize(views, points)
    found = depths(world.views(views), world.points(points))
    assert np.quantile(found, 0.02) == pytest.approx(NEAREST, rel=0.15)


def test_without_points_the_lines_of_sight_tell() -> None:
    target = np.array([7.0, -3.0, 2.0])
    views = ring(target, 5.0)
    world = normalize(views, np.zeros((0, 3)))
    np.testing.assert_allclose(world.centre, target, atol=1e-4)
    for view in world.views(views):
        assert np.linalg.norm(view.camera.centre) <= np.sqrt(3) * world.bound
        np.testing.assert_allclose(view.camera.translation, [0, 0, DISTANCE], atol=1e-3)


@pytest.mark.parametrize("known", [None, (1.0, 16.0)])
def test_parallel_lines_of_sight_have_a_middle_depth(known: tuple[float, float] | None) -> None:
    views = [view_at(np.array([i, 0, 0.0]), np.array([i, 1.0, 0])) for i in range(5)]
    world = normalize(views, np.zeros((0, 3)), known)
    distance = 4.0 if known else 2.0  # the mean of the depths' logarithms, or the cameras' spread
    np.testing.assert_allclose(world.centre, [2, distance, 0], atol=1e-9)
    assert world.scale == pytest.approx(DISTANCE / distance)


def test_a_single_camera_has_a_world_too() -> None:
    world = normalize([view_at(np.zeros(3), np.array([0, 1.0, 0]))], np.zeros((0, 3)))
    assert isinstance(world, World) and np.isfinite(world.centre).all() and world.bound > 0
