"""Which matches contradict the cameras: on motions that are known, and against other formulas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsdmsr_cli.capture import consistency
from gsdmsr_cli.capture.colmap import DATABASE
from gsdmsr_cli.capture.consistency import (
    WIDEST,
    coherent,
    essential_matrix,
    moving_share,
    rays_of,
    sampson_distance,
    turning_share,
)
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.scene import imaging  # noqa: F401  (before pycolmap, see there)
from gsdmsr_cli.scene.lens import Lens

LENS = Lens(500.0, 480.0, 310.0, 250.0, 640, 480)
STANDING, MOVING, FRAMES = 60, 20, 5


def pose(turn: tuple[float, float, float], shift: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return matrix


POSES = [pose((0.1 * i, -0.06 * i, 0.03 * i), (-0.3 * i, 0.1 * i, 0.05 * i)) for i in range(FRAMES)]


def seen(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    local = points @ camera[:3, :3].T + camera[:3, 3]
    return local[:, :2] / local[:, 2:]


def points_of(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1, -0.7, 3], [1.5, 0.7, 7], (count, 3))


def test_what_stands_fits_the_essential_matrix_and_what_moves_does_not() -> None:
    points, (first, second) = points_of(40), (POSES[1], POSES[4])
    essential = essential_matrix(first, second)
    one, other = seen(points, first), seen(points, second)
    assert sampson_distance(essential, one, other).max() < 1e-12
    assert (
        sampson_distance(essential, one, seen(points + np.array([0, 0.3, 0]), second)).min() > 1e-3
    )
    assert sampson_distance(essential_matrix(second, first), other, one).max() < 1e-12


def test_the_distance_is_the_error_over_the_length_of_its_gradient() -> None:
    """By all four coordinates, here from differences (Hartley & Zisserman, 11.4.3)."""
    essential = np.random.default_rng(3).normal(size=(3, 3))
    one, other = np.random.default_rng(4).normal(size=(2, 30, 2))

    def error(x: np.ndarray) -> np.ndarray:
        x1, x2 = (np.c_[part, np.ones(30)] for part in (x[:, :2], x[:, 2:]))
        return np.einsum("ni,ij,nj->n", x2, essential, x1)

    x, step = np.hstack([one, other]), 1e-6
    slopes = [(error(x + step * e) - error(x - step * e)) / (2 * step) for e in np.eye(4)]
    expected = np.abs(error(x)) / np.linalg.norm(slopes, axis=0)
    np.testing.assert_allclose(sampson_distance(essential, one, other), expected, rtol=1e-6)


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_the_turn_between_directions_is_a_rotation(seed: int, flat: bool) -> None:
    """Also where all lie in a plane, which a reflection would leave as it is."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    rays = rng.normal(size=(9, 3)) * [1, 0 if flat else 1, 1]
    lengths = rng.uniform(0.5, 3, (9, 1))
    found = consistency._turn(rays, lengths * (rays @ rotation.T))
    np.testing.assert_allclose(found, rotation, atol=1e-9)


@pytest.mark.parametrize(
    ("differing", "alike", "expected"),
    [(3.9, 4, True), (3.9, 3, True), (3.9, 2, False), (3.9, 0, False), (4.1, 4, False)],
)
def test_most_neighbours_must_move_alike(differing: float, alike: int, expected: bool) -> None:
    """A shift of 10 px is like another within a quarter of it and 1.5 px: 4 px."""
    places = np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [9, 9], [9, 8], [8, 9]], float)
    shifts = np.full((8, 2), -50.0)
    shifts[0] = 6.0, 8.0
    shifts[1 : 1 + alike] = shifts[0] + [0.0, differing]
    shifts[5:] = shifts[0]  # too far away to count
    asked = np.arange(8) == 0
    found = coherent(places.astype(np.float32), shifts.astype(np.float32), asked)
    assert found.tolist() == [expected]


def test_the_answers_are_of_those_that_were_asked_for() -> None:
    places = np.array([[i, j] for i in range(4) for j in range(3)], np.float32)
    shifts = np.tile(np.float32([3.0, 4.0]), (12, 1))
    shifts[5] = 40.0
    asked = np.isin(np.arange(12), [2, 5, 9])
    assert coherent(places, shifts, asked).tolist() == [True, False, True]
    assert coherent(places[:4], shifts[:4], asked[:4]).tolist() == [False]  # too few to tell
    assert coherent(places, shifts, np.zeros(12, bool)).tolist() == []


@pytest.mark.parametrize("radial", [(), (0.08, -0.02)])
def test_rays_are_what_the_lens_shows_at_pixels(radial: tuple[float, ...]) -> None:
    lens = Lens(500.0, 480.0, 310.0, 250.0, 640, 480, radial)
    rays = np.random.default_rng(1).uniform(-0.5, 0.5, (50, 2))
    pixels = np.stack(lens.project(rays[:, 0], rays[:, 1]), axis=1)
    np.testing.assert_allclose(rays_of(lens, pixels), rays, atol=1e-9)
    assert np.abs(rays_of(lens, np.array([[1e9, -1e9]]))).tolist() == [[WIDEST, WIDEST]]


def write_matches(folder: Path, pixels: list[np.ndarray]) -> Path:
    """Write a database in which point i of every frame is matched with point i of every other."""
    import pycolmap

    with pycolmap.Database.open(folder / DATABASE) as database:
        camera = pycolmap.Camera(
            model="PINHOLE", width=640, height=480, params=[500, 480, 310, 250]
        )
        number = database.write_camera(camera)
        ids = []
        for i, places in enumerate(pixels):
            ids.append(database.write_image(pycolmap.Image(f"{i:03d}.png", camera_id=number)))
            database.write_keypoints(ids[-1], places.astype(np.float32))
        matches = np.tile(np.arange(len(pixels[0]), dtype=np.uint32)[:, None], (1, 2))
        for i, first in enumerate(ids):
            for second in ids[i + 1 :]:
                database.write_matches(first, second, matches)
                geometry = pycolmap.TwoViewGeometry()
                geometry.config, geometry.inlier_matches = 3, matches
                database.write_two_view_geometry(first, second, geometry)
    return folder


def reconstruction() -> Reconstruction:
    names = tuple(f"{i:03d}.png" for i in range(FRAMES))
    nothing = np.zeros(0, np.int64)
    return Reconstruction(
        LENS, names, np.stack(POSES), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0),
        nothing, (nothing,) * FRAMES, (names,),
    )  # fmt: skip


def test_the_share_of_what_moves_is_found(tmp_path: Path) -> None:
    """Twenty of eighty points go up together, 0.2 a frame."""
    standing = points_of(STANDING) - [0.8, 0, 0]
    moving = points_of(MOVING, 1) * 0.1 + [1.3, 0, 4]  # beside them
    pixels = []
    for i, camera in enumerate(POSES):
        points = np.concatenate([standing, moving + 0.2 * i * np.eye(3)[1]])
        pixels.append(np.stack(LENS.project(*seen(points, camera).T), axis=1))
    found = moving_share(write_matches(tmp_path, pixels), reconstruction())
    assert found == pytest.approx(MOVING / (STANDING + MOVING))


def test_what_a_turning_camera_explains_is_found(tmp_path: Path) -> None:
    """All that is seen from one spot; of points at many depths seen by a camera that moves, few."""
    points = points_of(STANDING)
    turning = [pose((0.02 * i, -0.03 * i, 0.01 * i), (0, 0, 0)) for i in range(FRAMES)]
    square = Lens(500.0, 500.0, 310.0, 250.0, 640, 480)
    for name, poses in (("turning", turning), ("moving", POSES)):
        pixels = [np.stack(square.project(*seen(points, own).T), axis=1) for own in poses]
        (tmp_path / name).mkdir()
        share = turning_share(write_matches(tmp_path / name, pixels), square)
        assert share == 1.0 if name == "turning" else share < 0.5


def test_of_no_matches_nothing_moves_and_nothing_turns(tmp_path: Path) -> None:
    folder = write_matches(tmp_path, [np.zeros((0, 2))] * FRAMES)
    assert moving_share(folder, reconstruction()) == 0.0
    assert turning_share(folder, LENS) == 0.0
