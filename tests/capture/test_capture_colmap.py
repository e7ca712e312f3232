"""Features, pairs, lenses and epipolar geometry, against OpenCV, COLMAP and closed forms."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
import room
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.capture import colmap as colmap_jobs
from gsdmsr_cli.capture.child import run_child
from gsdmsr_cli.capture.colmap import DATABASE
from gsdmsr_cli.capture.consistency import essential_matrix, rays_of, sampson_distance
from gsdmsr_cli.capture.features import find_features, write_features
from gsdmsr_cli.capture.normalize import is_test, upright
from gsdmsr_cli.capture.options import CAMERA_MODELS, MATCHINGS
from gsdmsr_cli.capture.pairs import NEIGHBOURS, choose_pairs
from gsdmsr_cli.capture.reconstruction import lens_of
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.scene.native import load_pycolmap

PARAMS = {
    "SIMPLE_PINHOLE": [500.0, 320.0, 236.0],
    "PINHOLE": [500.0, 510.0, 320.0, 236.0],
    "SIMPLE_RADIAL": [500.0, 320.0, 236.0, -0.08],
    "RADIAL": [500.0, 320.0, 236.0, -0.08, 0.02],
    "OPENCV": [500.0, 510.0, 320.0, 236.0, -0.08, 0.02, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [500.0, 510.0, 320.0, 236.0, -0.05, 0.01, 0.002, -0.001],
}


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_lenses_project_as_colmap_does(model: str) -> None:
    colmap = load_pycolmap()
    camera = colmap.Camera(model=model, width=640, height=480, params=PARAMS[model])
    lens = lens_of(camera.model_name, camera.params, 640, 480)
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    expected = camera.img_from_cam(np.hstack([rays, np.ones((50, 1))]))
    np.testing.assert_allclose(np.stack(lens.project(*rays.T), 1), expected, atol=1e-9)
    back = rays_of(lens, expected.astype(np.float32))
    np.testing.assert_allclose(back, rays, atol=1e-6)


@given(st.integers(2, 150), st.sampled_from(MATCHINGS), st.booleans())
def test_pairs_are_ascending_and_connect_neighbours(count: int, matching: str, video: bool) -> None:
    pairs = choose_pairs(count, matching, video)
    assert pairs == sorted(set(pairs)) and all(0 <= i < j < count for i, j in pairs)
    near = {(i, j) for i, j in combinations(range(count), 2) if j - i <= NEIGHBOURS}
    assert near <= set(pairs)
    if matching == "exhaustive" or (matching == "auto" and not video and count <= 40):
        assert len(pairs) == count * (count - 1) // 2
    if matching == "both":
        assert (0, count - 1) in pairs


def test_features_are_in_pixels_of_the_frame_itself() -> None:
    """A picture at twice the size has its features at twice the places, counted from the corner."""
    grey = np.asarray(cv2.cvtColor(room.draw(room.walk(3)[1], 320, 240)[0], cv2.COLOR_RGB2GRAY))
    large = np.asarray(cv2.resize(grey, (2560, 1920), interpolation=cv2.INTER_NEAREST))
    small, big = find_features(grey, 400), find_features(large, 400)
    apart = np.linalg.norm(small.pixels[:, None] - big.pixels[None] / 8, axis=2).min(axis=1)
    assert np.median(apart) < 0.2  # half a pixel less or more would be seen
    assert small.descriptors.dtype == np.uint8 and len(small.pixels) >= 300
    lengths = np.linalg.norm(small.descriptors.astype(float), axis=1)
    assert np.abs(lengths - 512).max() < 15  # RootSIFT has unit length


def test_a_blank_picture_has_no_features() -> None:
    found = find_features(np.full((60, 80), 128, np.uint8), 100)
    assert found.pixels.shape == (0, 2) and found.descriptors.shape == (0, 128)


def test_standing_points_keep_to_their_epipolar_lines() -> None:
    rng = np.random.default_rng(0)
    first, second = (np.linalg.inv(pose) for pose in room.walk(2))
    points = rng.uniform(-1, 1, (40, 3)) + np.array([0, 2, 0])
    rays = [
        (p[:, :2] / p[:, 2:]) for p in (points @ w[:3, :3].T + w[:3, 3] for w in (first, second))
    ]
    essential = essential_matrix(first, second)
    assert sampson_distance(essential, *rays).max() < 1e-12
    # a small step off the epipolar line is that far off, shared by both pictures
    moved = rays[1] + np.array([0, 1e-5])
    off = sampson_distance(essential, rays[0], moved)
    assert 0 < off.max() <= 1e-5


def test_up_becomes_the_z_axis() -> None:
    tilt = cv2.Rodrigues(np.array([0.4, -0.3, 0.2]))[0]
    rotations = np.stack([np.linalg.inv(pose)[:3, :3] for pose in room.walk(5)]) @ tilt
    turn = upright(rotations)
    assert turn @ turn.T == pytest.approx(np.eye(3)) and np.linalg.det(turn) > 0
    up = turn @ -rotations[:, 1].mean(axis=0)
    assert up[:2] == pytest.approx([0, 0], abs=1e-12) and up[2] > 0


def test_every_eighth_view_is_for_testing_and_neither_end() -> None:
    assert [i for i in range(40) if is_test(i, 8)] == [4, 12, 20, 28, 36]
    assert not any(is_test(i, 0) for i in range(40))


def test_a_job_may_have_more_arguments_than_fit_a_command_line(tmp_path: Path) -> None:
    pairs = choose_pairs(300, "exhaustive", False)
    nothing = {"pictures": str(tmp_path / "none"), "names": [], "features": "", "masks": None}
    rest = {"camera_model": "PINHOLE", "focal": None, "pairs": pairs, "seed": 0}
    with pytest.raises(GsdmsrError, match="COLMAP has failed in its job match"):
        run_child("match", {"out": str(tmp_path), **nothing, **rest}, lambda done, total: None)


def test_the_number_of_cores_changes_no_match(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = room.write_pictures(tmp_path / "pictures", room.film(room.walk(14)[:6]))
    paths = sorted(pictures.iterdir())
    write_features(pictures, paths, 500, lambda done, total: None)
    monkeypatch.setattr(colmap_jobs, "PAIRS_AT_ONCE", 4)
    pairs = choose_pairs(6, "exhaustive", False)
    found = []
    for cores in (1, 3):
        monkeypatch.setattr(colmap_jobs, "cores", lambda cores=cores: cores)
        out = tmp_path / str(cores)
        out.mkdir()
        names = [path.name for path in paths]
        given = str(pictures), names, str(pictures), None, "PINHOLE", None
        colmap_jobs.match(str(out), *given, pairs, seed=0)
        assert capsys.readouterr().out.endswith("progress 15 15\n")
        assert not any(entry.is_dir() for entry in out.iterdir())
        with load_pycolmap().Database.open(out / DATABASE) as database:
            matches = dict(zip(*database.read_all_matches(), strict=True))
            verified = dict(zip(*database.read_two_view_geometries(), strict=True))
        found.append((matches, verified))
    (matches, verified), (shared, shared_verified) = found
    assert matches.keys() == shared.keys() and len(verified) > 10
    assert verified.keys() == shared_verified.keys()
    for pair, rows in matches.items():
        np.testing.assert_array_equal(rows, shared[pair])
    for pair, geometry in verified.items():
        other = shared_verified[pair]
        np.testing.assert_array_equal(geometry.inlier_matches, other.inlier_matches)
        np.testing.assert_array_equal(geometry.F, other.F)


def test_the_failure_of_a_share_is_told_once(tmp_path: Path) -> None:
    """A seed that is no number is noticed in a child of the child."""
    pictures = room.write_pictures(tmp_path / "pictures", room.film(room.walk(14)[:2]))
    paths = sorted(pictures.iterdir())
    write_features(tmp_path, paths, 100, lambda done, total: None)
    (tmp_path / "out").mkdir()
    given = {"out": str(tmp_path / "out"), "pictures": str(pictures), "features": str(tmp_path)}
    rest = {"masks": None, "camera_model": "PINHOLE", "focal": None, "seed": "none"}
    names = [path.name for path in paths]
    with pytest.raises(GsdmsrError, match=r"^COLMAP has failed in its job match_share: ") as failed:
        run_child("match", {**given, **rest, "names": names, "pairs": [[0, 1]]}, lambda *_: None)
    assert str(failed.value).count("has failed") == 1
