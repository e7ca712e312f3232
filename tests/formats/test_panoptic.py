"""The reader of PanopticSports, on a folder written from the format's definition."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import noise, write_json, write_picture
from refusals import assert_refused

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.pictures import Pictures

MOMENTS, WIDTH, HEIGHT = 3, 32, 24
TRAIN, TEST = (1, 4, 7), (0,)
POINTS = np.random.default_rng(0).normal(size=(200, 3)) * [1.0, 0.5, 1.0] + [3.0, 0.0, 7.0]
COLOURS = np.random.default_rng(1).random((200, 3))


def world_to_camera(camera: int) -> list[list[float]]:
    """On a circle of radius 5 round (3, 0, 7), facing it, y down."""
    cos, sin = math.cos(camera), math.sin(camera)
    rotation = np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    centre = np.array([3 - 5 * sin, 0, 7 - 5 * cos])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose.tolist()


def write_scene(folder: Path) -> Path:
    for split, cameras in (("train", TRAIN), ("test", TEST)):
        names = [[f"{c}/{t:06d}.png" for c in cameras] for t in range(MOMENTS)]
        k = [[40.0, 0.0, 15.5], [0.0, 41.0, 12.5], [0.0, 0.0, 1.0]]
        document = {
            "w": WIDTH,
            "h": HEIGHT,
            "fn": names,
            "cam_id": [list(cameras)] * MOMENTS,
            "k": [[k for _ in cameras]] * MOMENTS,
            "w2c": [[world_to_camera(c) for c in cameras]] * MOMENTS,
        }
        write_json(folder / f"{split}_meta.json", document)
        for name in chain.from_iterable(names):
            write_picture(folder / "ims" / name, noise(HEIGHT, WIDTH, 3))
            mask = (np.arange(WIDTH) < 10).astype(np.uint8)
            write_picture(folder / "seg" / name, np.tile(mask[None, :, None], (HEIGHT, 1, 1)))
    table = np.concatenate([POINTS, COLOURS, np.ones((len(POINTS), 1))], axis=1)
    np.savez(folder / "init_pt_cld.npz", data=table)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


def test_a_scene_is_read(folder: Path) -> None:
    scene = read_scene(folder)
    assert scene.layout == "panoptic"
    assert len(scene.split("train")) == 9 and len(scene.split("test")) == 3
    assert scene.train_times == [0, 0.5, 1]
    view = scene.split("train")[4]
    assert view.name == "4_000001" and view.time == 0.5
    assert view.image_path == folder / "ims" / "4" / "000001.png"
    camera = view.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (40, 41, 15.5, 12.5)
    np.testing.assert_allclose(camera.rotation, np.array(world_to_camera(4))[:3, :3])
    assert scene.colours is not None
    np.testing.assert_allclose(scene.colours, COLOURS, atol=1e-6)


def test_points_project_as_before(folder: Path) -> None:
    scene = read_scene(folder)
    pose = np.array(world_to_camera(7))
    camera = next(view for view in scene.views if view.name == "7_000000").camera
    before = POINTS @ pose[:3, :3].T + pose[:3, 3]
    after = scene.points @ camera.rotation.T + camera.translation
    np.testing.assert_allclose(
        after[:, :2] / after[:, 2:], before[:, :2] / before[:, 2:], atol=1e-4
    )


def test_what_moves_is_1_in_seg(folder: Path) -> None:
    view = read_scene(folder).views[0]
    moving = Pictures((0.0, 0.0, 0.0), 1, 1 << 20).signal(view, "moving")
    assert moving is not None and view.signals.keys() == {"moving"}
    assert moving[:, :10].all() and not moving[:, 10:].any()


def test_pictures_may_have_been_halved(folder: Path) -> None:
    for kind, channels in (("ims", 3), ("seg", 1)):
        for path in (folder / kind).glob("*/*.png"):
            write_picture(path, noise(HEIGHT // 2, WIDTH // 2, channels))
    for view in read_scene(folder).views:
        c = view.camera
        assert (c.width, c.height) == (WIDTH // 2, HEIGHT // 2)
        assert (c.fx, c.fy, c.cx, c.cy) == (20, 20.5, 7.75, 6.25)


def test_points_that_are_no_numbers_are_left_out(folder: Path) -> None:
    expected = read_scene(folder)
    table = np.concatenate([POINTS, COLOURS, np.ones((len(POINTS), 1))], axis=1)
    broken = table[:4].copy()
    broken[[0, 1, 2, 3], [0, 2, 4, 1]] = [np.nan, np.inf, np.nan, -np.inf]
    points(np.concatenate([broken[:2], table, broken[2:]]))(folder)
    found = read_scene(folder)
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_array_equal(found.colours, expected.colours)


def test_the_world_is_that_of_the_first_moment_where_the_rig_moves(folder: Path) -> None:
    """All cameras leave by 100 at once; the points, which lie where they began, are the measure."""
    still = read_scene(folder)

    def leave(document: dict[str, Any]) -> None:
        for t, poses in enumerate(document["w2c"]):
            for pose in poses:
                pose[2][3] += 100.0 * t

    change(leave)(folder)
    moved = read_scene(folder)
    np.testing.assert_allclose(moved.points, still.points, rtol=1e-6)
    assert moved.bound == pytest.approx(still.bound)


def test_seg_points_and_the_test_split_may_be_missing(folder: Path) -> None:
    (folder / "seg").rename(folder / "other")
    (folder / "init_pt_cld.npz").unlink()
    (folder / "test_meta.json").unlink()
    scene = read_scene(folder)
    assert len(scene.views) == 9 and not len(scene.points)
    assert not any(view.signals for view in scene.views)
    for view in scene.views:  # the lines of sight meet 5 units ahead
        np.testing.assert_allclose(view.camera.translation, [0, 0, 4], atol=1e-3)


def change(edit: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        path = folder / "train_meta.json"
        document = json.loads(path.read_text())
        edit(document)
        write_json(path, document)

    return spoil


def points(data: np.ndarray, key: str = "data") -> Callable[[Path], Any]:
    return lambda folder: np.savez(folder / "init_pt_cld.npz", **{key: data})


def cut_points(folder: Path) -> None:
    path = folder / "init_pt_cld.npz"
    path.write_bytes(path.read_bytes()[:100])


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no width": (change(lambda d: d.pop("w")), "w is None"),
    "no names": (change(lambda d: d.pop("fn")), "fn: None found"),
    "moments differ": (change(lambda d: d["k"].pop()), "have different lengths"),
    "cameras differ": (change(lambda d: d["fn"][1].pop()), "moment 1: .*numbers of cameras"),
    "no moments": (change(lambda d: d.update(fn=[], k=[], w2c=[])), "no train frames"),
    "k of two rows": (change(lambda d: d["k"][0][1].pop()), "moment 0, camera 1: k is not 3 x 3"),
    "k of text": (change(lambda d: d["k"][0].__setitem__(0, "x")), "k: 'x' found"),
    "focal length 0": (change(lambda d: d["k"][0][0][0].__setitem__(0, 0)), "it must be above 0"),
    "a pose of three rows": (change(lambda d: d["w2c"][0][0].pop()), "w2c is not 4 x 4"),
    "a picture outside": (change(lambda d: d["fn"][0].__setitem__(0, "../a.png")), "leads out of"),
    "a name that is none": (change(lambda d: d["fn"][0].__setitem__(0, 7)), "must name a file"),
    "a picture gone": (lambda f: (f / "ims/4/000001.png").unlink(), "000001.png does not exist"),
    "another shape": (change(lambda d: d.update(w=64)), "camera's size is 64 x 24"),
    "a small mask": (
        lambda f: write_picture(f / "seg/4/000001.png", noise(4, 4, 1)), "mask .*is 4 x 4 px"),
    "flat points": (points(np.zeros((5, 3))), r"shape \(5, 3\); it must be"),
    "points of another name": (points(np.zeros((5, 7)), "points"), "has no 'data'"),
    "torn points": (cut_points, r"init_pt_cld\.npz: is damaged"),
    "points of text": (points(np.full((5, 7), "a")), "no 'data' of numbers"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(
    folder: Path, spoil: Callable[[Path], Any], message: str
) -> None:
    write_picture(folder / "a.png", noise(HEIGHT, WIDTH, 3))
    spoil(folder)
    assert_refused(folder, message)
