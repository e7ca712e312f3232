"""Lenses against OpenCV's own projection, and the pinholes that stand in for them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets import write_picture
from hypothesis import given, settings
from hypothesis import strategies as st

from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View

BROWN = Lens(90.0, 80.0, 50.5, 38.0, 100, 80, (0.1, -0.05, 0.02), (0.004, -0.003))
RATIONAL = Lens(90.0, 80.0, 49.0, 41.0, 100, 80, (0.2, 0.1, 0.01, 0.3, 0.05, 0.02), (0.01, 0.02))
FISHEYE = Lens(60.0, 62.0, 50.0, 40.0, 100, 80, (0.05, -0.02, 0.01, -0.003), fisheye=True)
SKEWED = Lens(90.0, 80.0, 50.0, 40.0, 100, 80, skew=1.5)
LENSES = {"brown": BROWN, "rational": RATIONAL, "fisheye": FISHEYE, "skewed": SKEWED}


def directions(count: int = 50) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.5, 0.5, (count, 2))


def by_opencv(lens: Lens, xy: np.ndarray) -> np.ndarray:
    matrix = np.array([[lens.fx, lens.skew, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    none = np.zeros(3)
    if lens.fisheye:
        alpha = lens.skew / lens.fx
        found = cv2.fisheye.distortPoints(xy[:, None], matrix, np.array(lens.radial), alpha=alpha)
        return found[:, 0]
    k = (*lens.radial, *[0.0] * (6 - len(lens.radial)))
    coefficients = np.array([k[0], k[1], *lens.tangential, *k[2:]])
    points = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return cv2.projectPoints(points, none, none, matrix, coefficients)[0][:, 0]


@pytest.mark.parametrize("name", ["brown", "rational", "fisheye"])
def test_projection_is_opencvs(name: str) -> None:
    lens, xy = LENSES[name], directions()
    u, v = lens.project(xy[:, 0], xy[:, 1])
    np.testing.assert_allclose(np.stack([u, v], 1), by_opencv(lens, xy), atol=1e-9)


def test_skew_moves_what_is_low_to_the_right() -> None:
    u, v = SKEWED.project(np.array([0.1]), np.array([0.2]))
    assert u[0] == pytest.approx(90 * 0.1 + 1.5 * 0.2 + 50) and v[0] == pytest.approx(80 * 0.2 + 40)


@pytest.mark.parametrize("name", LENSES)
def test_a_resized_lens_projects_to_the_resized_picture(name: str) -> None:
    lens, xy = LENSES[name], directions()
    u, v = lens.project(xy[:, 0], xy[:, 1])
    small_u, small_v = lens.resized(50, 20).project(xy[:, 0], xy[:, 1])
    np.testing.assert_allclose(small_u, u / 2, atol=1e-12)
    np.testing.assert_allclose(small_v, v / 4, atol=1e-12)


def test_what_bends_nothing_is_a_pinhole() -> None:
    plain = Lens(90.0, 80.0, 50.5, 38.0, 100, 80, (0.0, 0.0, 0.0))
    assert plain.is_pinhole
    assert not any(lens.is_pinhole for lens in LENSES.values())
    camera = plain.camera(np.eye(4))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (90, 80, 50.5, 38)


def test_terms_that_a_model_does_not_have_are_refused() -> None:
    with pytest.raises(ValueError, match="7 radial terms"):
        Lens(1.0, 1.0, 0.0, 0.0, 2, 2, (0.0,) * 7)
    with pytest.raises(ValueError, match="no tangential terms"):
        Lens(1.0, 1.0, 0.0, 0.0, 2, 2, (), (0.1, 0.0), fisheye=True)


def corners_seen(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Return the recorded pixels at the border of the pinhole's picture."""
    camera = lens.camera(np.eye(4))
    along = np.linspace(0, 1, 201)
    ends = np.repeat([0.0, 1.0], len(along))
    columns = camera.width * np.concatenate([along, along, ends])
    rows = camera.height * np.concatenate([ends, along, along])
    return lens.project((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1)),
    st.tuples(st.floats(-0.02, 0.02), st.floats(-0.02, 0.02)),
    st.booleans(),
)
def test_the_pinhole_shows_all_it_can_and_nothing_else(
    radial: tuple[float, float], tangential: tuple[float, float], fisheye: bool
) -> None:
    bent = () if fisheye else tangential
    lens = Lens(90.0, 85.0, 48.0, 41.0, 100, 80, radial, *([bent] if bent else []), fisheye=fisheye)
    u, v = corners_seen(lens)
    gap = min(u.min(), v.min(), (lens.width - u).min(), (lens.height - v).min())
    # the border is tried at 41 points a side; between them it can stand out by a hair
    assert -0.05 <= gap <= 0.05


def test_a_fisheye_keeps_its_resolution_in_the_middle() -> None:
    """One of 180 degrees has rays for a pinhole of any width."""
    lens = Lens(100 / np.pi, 100 / np.pi, 50.0, 50.0, 100, 100, fisheye=True)
    assert lens.camera(np.eye(4)).fx == pytest.approx(0.7 * 100 / np.pi, rel=1e-6)


def test_a_lens_that_folds_at_the_rim_is_zoomed_past_the_fold() -> None:
    """1 + k r^2 with k = -0.5 is not monotone beyond r = sqrt(1 / 1.5) = 0.82."""
    lens = Lens(50.0, 50.0, 50.0, 50.0, 100, 100, (-0.5,))
    camera = lens.camera(np.eye(4))
    # the fold is noticed once it fills half of one of the 20 cells between middle and rim
    assert np.hypot(50 / camera.fx, 50 / camera.fy) <= np.sqrt(1 / 1.5) * (1 + 1 / 40)


def test_straight_lines_are_straight_after_undistortion(tmp_path: Path) -> None:
    """A smooth pattern recorded through the lens becomes the picture that a pinhole takes."""

    def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 127 + 60 * np.sin(12 * x) + 60 * np.cos(9 * y + 4 * x)

    rows, columns = np.mgrid[:80, :100] + 0.5
    pixels = np.stack([columns, rows], -1).reshape(-1, 2)
    xy = np.zeros_like(pixels)
    for _ in range(60):  # a fixed point: the lens bends little
        xy -= (by_opencv(BROWN, xy) - pixels) / [BROWN.fx, BROWN.fy]
    assert np.abs(by_opencv(BROWN, xy) - pixels).max() < 1e-9
    recorded = pattern(xy[:, 0], xy[:, 1]).reshape(80, 100)
    picture = np.rint(recorded).astype(np.uint8)[..., None].repeat(3, 2)
    write_picture(tmp_path / "a.png", picture)
    write_picture(tmp_path / "mask.png", (picture > 127).astype(np.uint8)[..., :1] * 255)
    camera = BROWN.camera(np.eye(4))
    signals = {"mask": tmp_path / "mask.png"}
    view = View("a", camera, 0.0, "train", tmp_path / "a.png", signals, BROWN)
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 20)
    found = pictures.load(view)[0].numpy().astype(float)
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    expected = pattern(x, y)
    assert np.abs(found - expected)[2:-2, 2:-2].max() < 2
    assert np.abs(found - recorded).max() > 10  # and it was bent before
    counted = pictures.signal(view, "mask")
    assert counted is not None
    clear = np.abs(expected - 127) > 12
    assert (counted.numpy() == (expected > 127))[clear].all()
