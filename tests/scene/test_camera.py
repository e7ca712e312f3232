"""Cameras of pictures in other sizes, on pixels worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from gsdmsr_cli.scene.camera import Camera, look_at

CAMERA = Camera(np.eye(4), 50.0, 60.0, 22.0, 13.0, 40, 30)


def pixel(camera: Camera, x: float, y: float) -> tuple[float, float]:
    return camera.fx * x + camera.cx, camera.fy * y + camera.cy


@pytest.mark.parametrize(("width", "height"), [(80, 60), (20, 15), (80, 15)])
def test_a_resampled_picture_shows_the_same(width: int, height: int) -> None:
    small = CAMERA.resized(width, height)
    assert (small.width, small.height) == (width, height)
    for x, y in ((0.0, 0.0), (0.3, -0.2)):
        u, v = pixel(CAMERA, x, y)
        assert pixel(small, x, y) == pytest.approx((u * width / 40, v * height / 30))


@pytest.mark.parametrize(("width", "height"), [(80, 60), (27, 20), (40, 30)])
def test_a_frame_of_the_same_proportions_is_the_picture_resampled(width: int, height: int) -> None:
    """But for rounding: 27 x 20 is 26.67 x 20."""
    framed, resized = CAMERA.framed(width, height), CAMERA.resized(width, height)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(framed, name) == getattr(resized, name)


@pytest.mark.parametrize(
    ("width", "height", "scale", "left", "top"),
    [(100, 30, 1.0, 30.0, 0.0), (40, 90, 1.0, 0.0, 30.0), (60, 15, 0.5, 20.0, 0.0),
     (30, 40, 0.75, 0.0, 8.75), (30, 30, 0.75, 0.0, 3.75)],
)  # fmt: skip
def test_another_frame_shows_more_at_two_sides(
    width: int, height: int, scale: float, left: float, top: float
) -> None:
    """The whole picture, shrunk or not, with as much on either side."""
    framed = CAMERA.framed(width, height)
    assert (framed.width, framed.height) == (width, height)
    for x, y in ((0.0, 0.0), (0.3, -0.2)):
        u, v = pixel(CAMERA, x, y)
        assert pixel(framed, x, y) == pytest.approx((left + scale * u, top + scale * v))


def test_a_camera_that_looks_at_a_point_has_it_ahead_and_up_above() -> None:
    centre, target, up = np.array([1.0, 2, 3]), np.array([4.0, -1, 5]), np.array([0.2, 0.1, 1.0])
    pose = look_at(centre, target, up)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    distance = np.linalg.norm(target - centre)
    np.testing.assert_allclose(pose[:3, :3] @ target + pose[:3, 3], [0, 0, distance], atol=1e-12)
    x, y, _ = pose[:3, :3] @ up
    assert abs(x) < 1e-12 and y < 0  # pictures have y down
    camera = Camera(pose, 1.0, 1.0, 1.0, 1.0, 2, 2)
    np.testing.assert_allclose(camera.centre, centre)
