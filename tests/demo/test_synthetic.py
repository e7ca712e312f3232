"""The demo scene: its layout, its geometry against closed forms, and that seeds decide it."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from full_disk import full_at_every_change, has_failed
from numpy.typing import NDArray

from gsdmsr_cli.demo import synthetic
from gsdmsr_cli.demo.solids import Ball, Disc
from gsdmsr_cli.demo.synthetic import CAMERA_ANGLE_X, Placed, camera_on_dome, draw, write_scene
from gsdmsr_cli.formats import dnerf
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import read_image

SIZE = 48

FEW = {"size": 8, "train": 2, "val": 1, "test": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("synthetic") / "scene"
    write_scene(folder, size=SIZE, train=6, val=2, test=3)
    return folder


def ball(centre: list[float], radius: float) -> Placed:
    return Placed(Ball(radius), np.eye(3), np.array(centre))


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_the_reader_takes_it_as_a_dnerf_scene(folder: Path) -> None:
    scene = dnerf.read(folder)
    assert [len(scene.split(split)) for split in ("train", "val", "test")] == [6, 2, 3]
    for split in ("train", "val", "test"):
        times = [view.time for view in scene.split(split)]
        np.testing.assert_allclose(times, np.linspace(0, 1, len(times)))
    for view in scene.views:
        assert (view.camera.width, view.camera.height) == (SIZE, SIZE)
        assert math.isclose(np.linalg.norm(view.camera.centre), 4.0)
        assert view.camera.centre[2] > 0
        # the origin falls on the centre of every picture, in front of the camera
        x, y, z = view.camera.translation
        np.testing.assert_allclose([x, y, z], [0, 0, 4], atol=1e-9)


def test_the_matrices_are_camera_to_world_in_opengl_axes(folder: Path) -> None:
    document = json.loads((folder / "transforms_train.json").read_text())
    for frame in document["frames"]:
        matrix = np.array(frame["transform_matrix"])
        right, up, backward, centre = matrix[:3].T
        np.testing.assert_allclose(backward, centre / 4.0, atol=1e-9)
        assert abs(right[2]) < 1e-9
        assert up[2] > 0
        assert math.isclose(np.linalg.det(matrix[:3, :3]), 1.0)


def expected_ball(matrix: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far each pixel's ray passes from ``centre``, (SIZE, SIZE), by the layout alone."""
    focal = 0.5 * SIZE / math.tan(CAMERA_ANGLE_X / 2)
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    rays = np.stack([(columns - SIZE / 2) / focal, (SIZE / 2 - rows) / focal, -np.ones_like(rows)])
    rays = np.einsum("ij,jhw->hwi", matrix[:3, :3], rays)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    distances: NDArray[np.float64] = np.linalg.norm(np.cross(rays, centre - matrix[:3, 3]), axis=-1)
    return distances


def test_a_ball_is_drawn_where_the_layout_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    centre, radius = np.array([-0.4, 0.3, 0.5]), 0.35
    monkeypatch.setattr(synthetic, "solids_at", lambda _: [ball(centre.tolist(), radius)])
    write_scene(tmp_path, size=SIZE, train=5, val=1, test=1)
    document = json.loads((tmp_path / "transforms_train.json").read_text())
    pixel = 4.0 * math.tan(CAMERA_ANGLE_X / 2) * 2 / SIZE
    for frame in document["frames"]:
        alpha = read_image(tmp_path / f"{frame['file_path']}.png")[..., 3]
        beside = expected_ball(np.array(frame["transform_matrix"]), centre)
        inner, outer = beside < radius - pixel, beside > radius + pixel
        assert inner.sum() > 20
        assert (alpha[inner] == 255).all()
        assert (alpha[outer] == 0).all()


@pytest.mark.parametrize("size", [64, 101])
def test_a_ball_on_the_axis_covers_the_area_of_its_silhouette(size: int) -> None:
    radius, distance = 0.5, 4.0
    alpha = draw([ball([0, 0, 0], radius)], camera_on_dome(0.3, 0.7, size))[..., 3] / 255
    focal = 0.5 * size / math.tan(CAMERA_ANGLE_X / 2)
    area = math.pi * (focal * radius) ** 2 / (distance**2 - radius**2)
    assert alpha.sum() == pytest.approx(area, rel=0.01)
    rows, columns = np.mgrid[:size, :size] + 0.5
    assert (alpha * rows).sum() / alpha.sum() == pytest.approx(size / 2, abs=0.05)
    assert (alpha * columns).sum() / alpha.sum() == pytest.approx(size / 2, abs=0.05)


def test_alpha_counts_nine_rays_and_colour_is_straight(folder: Path) -> None:
    levels = {round(255 * k / 9) for k in range(10)}
    pixels = read_image(folder / "train" / "r_000.png")
    assert pixels.shape == (SIZE, SIZE, 4)
    found = set(np.unique(pixels[..., 3]).tolist())
    assert {0, 255} < found <= levels
    # straight alpha: a pixel one ninth covered is as bright as its solid, not a ninth of it
    thin = (pixels[..., 3] > 0) & (pixels[..., 3] < 128)
    assert thin.sum() > 5
    assert np.median(pixels[thin][:, :3].max(-1)) > 60
    assert (pixels[pixels[..., 3] == 0] == 0).all()


def test_a_nearer_ball_hides_a_farther_one_whatever_their_order() -> None:
    camera = camera_on_dome(0.0, 0.0, SIZE)
    near, far = ball([1, 0, 0], 0.2), Placed(Disc(0.9), np.eye(3)[[2, 1, 0]], np.zeros(3))
    alone = draw([near], camera)
    for order in ([near, far], [far, near]):
        both = draw(order, camera)
        opaque = alone[..., 3] == 255
        assert opaque.sum() > 20
        np.testing.assert_array_equal(both[opaque], alone[opaque])
        assert both[..., 3].sum() > 2 * alone[..., 3].sum()


def test_a_ball_throws_a_shadow_along_the_light() -> None:
    camera = camera_on_dome(-math.pi / 2, 1.2, 100)
    ground = Placed(Disc(1.2), np.eye(3), np.array([0.0, 0.0, -0.5]))
    plain, shaded = draw([ground], camera), draw([ground, ball([0, 0, 0.2], 0.2)], camera)
    light = synthetic._TO_LIGHT[:, 0].astype(float)
    for position, dark in [(-0.7 * light / light[2], True), (0.7 * light / light[2], False)]:
        point = np.array([position[0], position[1], -0.5])
        x, y, z = camera.rotation @ point + camera.translation
        column, row = int(camera.fx * x / z + camera.cx), int(camera.fy * y / z + camera.cy)
        ratio = shaded[row, column, 0] / plain[row, column, 0]
        assert bool(ratio < 0.6) is dark


def test_the_scene_stays_in_its_box_and_above_the_ground() -> None:
    for time in np.linspace(0, 1, 41):
        placed = synthetic.solids_at(float(time))
        for solid in placed:
            assert (abs(solid.position) + solid.solid.radius <= 1.3).all() or solid is placed[0]
            np.testing.assert_allclose(solid.rotation @ solid.rotation.T, np.eye(3), atol=1e-12)
        assert placed[0].solid.radius <= 1.3
        assert placed[1].position[2] >= synthetic.FLOOR + synthetic.BALL_RADIUS - 1e-9


def test_everything_but_the_ground_moves() -> None:
    before, after = synthetic.solids_at(0.1), synthetic.solids_at(0.3)
    moved = [
        not (np.allclose(a.position, b.position) and np.allclose(a.rotation, b.rotation))
        for a, b in zip(before, after, strict=True)
    ]
    assert moved == [False, True, True, True]


def test_the_same_seed_writes_the_same_files_and_another_does_not(tmp_path: Path) -> None:
    for name, seed in [("a", 3), ("b", 3), ("c", 4)]:
        write_scene(tmp_path / name, size=24, train=3, val=1, test=1, seed=seed)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert contents(tmp_path / "a") != contents(tmp_path / "c")


def test_progress_counts_every_picture(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    write_scene(tmp_path, 16, 2, 1, 1, progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


@pytest.mark.parametrize("time", [0.0, 0.1, 0.25, 0.5, 0.85])
def test_the_solids_move_as_told(time: float) -> None:
    """A ball that bounces twice, a box that turns where it stands, a pendulum that swings once."""
    disc, bouncing, box, pendulum = synthetic.solids_at(time)
    np.testing.assert_allclose(disc.position, [0, 0, synthetic.FLOOR])
    share = 2 * time % 1  # of a bounce: a parabola of height 0.75
    height = 0.75 * (1 - (2 * share - 1) ** 2)
    resting = synthetic.FLOOR + synthetic.BALL_RADIUS
    np.testing.assert_allclose(bouncing.position, [-0.55, -0.35, resting + height])
    np.testing.assert_allclose(box.position, [0.55, -0.4, synthetic.FLOOR + 0.35])
    turn, swing = 0.3 + 2.1 * time, 0.6 * math.sin(2 * math.pi * time)
    np.testing.assert_allclose(
        box.rotation @ [1, 0, 0], [math.cos(turn), math.sin(turn), 0], atol=1e-12
    )
    pivot = np.array([0.0, 0.55, 0.9])
    rod = 0.95 * np.array([-math.sin(swing), 0.0, -math.cos(swing)])
    np.testing.assert_allclose(pendulum.position, pivot + rod, atol=1e-12)
    np.testing.assert_allclose(pendulum.rotation @ [0, 0, -0.95], rod, atol=1e-12)


def test_a_disk_that_is_full_at_any_change_is_told(tmp_path: Path) -> None:
    for folder, full in full_at_every_change(tmp_path, 10, 2):
        with full:
            try:
                write_scene(folder, **FEW)
            except (DataError, OSError) as error:
                assert "No space left on device" in str(error)
        if has_failed():
            write_scene(folder, **FEW)
        assert len(dnerf.read(folder).views) == 4


@pytest.mark.skipif(sys.platform == "win32", reason="files cannot be bounded there")
def test_transforms_that_do_not_fit_on_the_disk_are_not_there(tmp_path: Path) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (700, before[1]))  # more than a picture has [bytes]
    try:
        with pytest.raises(DataError, match="File too large"):
            write_scene(tmp_path, **FEW)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(list(tmp_path.rglob("*.png"))) == 4 and not list(tmp_path.glob("*.*"))
