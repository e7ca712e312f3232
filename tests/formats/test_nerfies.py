"""The reader of Nerfies and HyperNeRF, against numbers worked out from the format's definition."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import noise, write_json, write_picture
from refusals import assert_refused

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene

POINTS = np.random.default_rng(5).normal(size=(200, 3)) * 0.3 + [1.0, 2.0, 3.0]


def camera_at(angle: float, size: tuple[int, int] = (40, 64)) -> dict[str, Any]:
    """A camera 2 units from (1, 2, 3), on a circle round it, that faces it; OpenCV axes."""
    cos, sin = math.cos(angle), math.sin(angle)
    return {
        # rows: right, down, forward
        "orientation": [[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]],
        "position": [1 - 2 * sin, 2.0, 3 - 2 * cos],
        "focal_length": 50.0,
        "principal_point": [19.0, 33.0],
        "skew": 0.5,
        "pixel_aspect_ratio": 1.1,
        "radial_distortion": [0.08, -0.04, 0.01],
        "tangential_distortion": [0.003, -0.002],
        "image_size": list(size),
    }


def write_capture(
    folder: Path, count: int = 9, val: tuple[int, ...] = (2, 5), scale: str = "2x"
) -> Path:
    names = [f"{i:06d}" for i in range(count)]
    held = [names[i] for i in val]
    write_json(
        folder / "dataset.json",
        {
            "ids": names,
            "train_ids": [name for name in names if name not in held] if held else [],
            "val_ids": held,
        },
    )
    write_json(folder / "metadata.json", {n: {"warp_id": i} for i, n in enumerate(names)})
    write_json(folder / "scene.json", {"scale": 0.5, "center": [1, 2, 3], "near": 0.5, "far": 2.0})
    shape = {"1x": (64, 40), "2x": (32, 20)}[scale]
    for i, name in enumerate(names):
        write_json(folder / "camera" / f"{name}.json", camera_at(0.3 * i))
        write_picture(folder / "rgb" / scale / f"{name}.png", noise(*shape, 3, seed=i))
    np.save(folder / "points.npy", POINTS)
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "capture")


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    document = json.loads(path.read_text())
    change(document)
    write_json(path, document)


def by_hand(camera: dict[str, Any], point: np.ndarray) -> tuple[float, float]:
    """The pixel of a world point at the camera's own size, as google/nerfies defines it."""
    x, y, z = np.array(camera["orientation"]) @ (point - camera["position"])
    x, y = x / z, y / z
    k1, k2, k3 = camera["radial_distortion"]
    p1, p2 = camera["tangential_distortion"]
    r2 = x**2 + y**2
    bend = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * bend + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    bent_y = y * bend + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    focal, (cx, cy) = camera["focal_length"], camera["principal_point"]
    u = focal * bent_x + camera["skew"] * bent_y + cx
    return u, focal * camera["pixel_aspect_ratio"] * bent_y + cy


@pytest.mark.parametrize("scale", [1, 2])
def test_points_fall_on_the_pixels_that_the_format_defines(tmp_path: Path, scale: int) -> None:
    scene = read_scene(write_capture(tmp_path, scale=f"{scale}x"))
    assert scene.layout == "nerfies"
    for i, view in enumerate(sorted(scene.views, key=lambda view: view.name)):
        camera, lens = view.camera, view.lens
        assert lens is not None and view.name == f"{i:06d}"
        assert (camera.width, camera.height) == (40 // scale, 64 // scale)
        for normalized, point in zip(scene.points[::20].astype(float), POINTS[::20], strict=True):
            x, y, z = camera.rotation @ normalized + camera.translation
            column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
            u, v = lens.project(
                np.array((column - camera.cx) / camera.fx), np.array((row - camera.cy) / camera.fy)
            )
            expected = by_hand(camera_at(0.3 * i), point)
            assert (float(u) * scale, float(v) * scale) == pytest.approx(expected, abs=1e-3)


def test_test_frames_are_those_that_the_capture_keeps_for_validation(folder: Path) -> None:
    scene = read_scene(folder)
    assert [view.name for view in scene.split("test")] == ["000002", "000005"]
    assert len(scene.split("train")) == 7 and len(scene.views) == 9
    assert [view.time for view in scene.split("test")] == [2 / 8, 5 / 8]
    assert scene.train_times == [i / 8 for i in (0, 1, 3, 4, 6, 7, 8)]


def test_without_such_frames_every_fourth_trains_and_those_between_test(tmp_path: Path) -> None:
    scene = read_scene(write_capture(tmp_path, count=12, val=()))
    assert [view.name[-2:] for view in scene.split("train")] == ["00", "04", "08"]
    assert [view.name[-2:] for view in scene.split("test")] == ["02", "06"]
    assert [view.time for view in scene.split("train")] == [0, 4 / 11, 8 / 11]


def test_the_time_of_two_cameras_is_their_time_id(folder: Path) -> None:
    """In vrig captures two cameras see each moment, and each picture has a warp of its own."""

    def pair(metadata: dict[str, Any]) -> None:
        for i, entry in enumerate(metadata.values()):
            entry.update(time_id=i // 2, camera_id=i % 2)

    edit(folder / "metadata.json", pair)
    times = {view.name: view.time for view in read_scene(folder).views}
    assert [times[f"{i:06d}"] for i in range(9)] == [i // 2 / 4 for i in range(9)]


def test_a_capture_of_one_moment(folder: Path) -> None:
    edit(folder / "metadata.json", lambda d: [entry.update(warp_id=0) for entry in d.values()])
    assert {view.time for view in read_scene(folder).views} == {0.0}


def test_the_older_key_of_the_tangential_terms(folder: Path) -> None:
    def rename(camera: dict[str, Any]) -> None:
        camera["tangential"] = camera.pop("tangential_distortion")

    before = read_scene(folder).views[0].lens
    edit(folder / "camera" / "000000.json", rename)
    after = read_scene(folder).views[0].lens
    assert before is not None and before == after and after.tangential == (0.003, -0.002)


def test_cameras_without_distortion_are_pinholes(folder: Path) -> None:
    for path in (folder / "camera").glob("*.json"):
        edit(path, lambda camera: [camera.pop(key) for key in list(camera) if "distortion" in key])
        edit(path, lambda camera: camera.update(skew=0.0))
    view = read_scene(folder).views[0]
    assert view.lens is None
    assert (view.camera.fx, view.camera.cx, view.camera.cy) == (25, 9.5, 16.5)
    assert view.camera.fy == pytest.approx(27.5)


def test_the_papers_resolution_is_taken_where_it_is_there(folder: Path) -> None:
    for i in range(9):
        write_picture(folder / "rgb" / "1x" / f"{i:06d}.png", noise(64, 40, 3))
    assert read_scene(folder).views[0].image_path.parent == folder / "rgb" / "2x"


def test_a_capture_without_points_is_normalized_by_its_cameras(folder: Path) -> None:
    (folder / "points.npy").unlink()
    scene = read_scene(folder)
    assert scene.points.shape == (0, 3)
    for view in scene.views:  # all of them face one point, from 2 units away
        np.testing.assert_allclose(view.camera.translation, [0, 0, 4], atol=1e-3)


def test_pictures_are_undistorted_when_they_are_decoded(folder: Path) -> None:
    """A ramp of levels across the picture tells where each pixel was taken from."""
    rows, columns = np.mgrid[:32, :20]
    ramps = np.stack([10 * columns, 7 * rows, 0 * rows], axis=2)
    write_picture(folder / "rgb" / "2x" / "000000.png", ramps.astype(np.uint8))
    view = next(view for view in read_scene(folder).views if view.name == "000000")
    picture = Pictures((1.0, 1.0, 1.0), 1, 1 << 20).load(view)
    assert picture.shape == (3, 32, 20)
    camera, own = view.camera, camera_at(0.0)
    for column, row in ((4, 5), (10, 16), (15, 25), (7, 27)):
        ahead = [(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0]
        u, v = by_hand(own, np.array(own["position"]) + ahead)  # the camera is not turned
        found = picture[:, row, column].tolist()
        assert found[0] == pytest.approx(10 * (u / 2 - 0.5), abs=1.0)
        assert found[1] == pytest.approx(7 * (v / 2 - 0.5), abs=1.0)


def test_without_points_the_depths_of_the_scene_tell_where_it_is(folder: Path) -> None:
    """They are in units of the scale: 0.5 to 8 at 0.5 are 1 to 16, in the middle 4 (geometric)."""
    (folder / "points.npy").unlink()
    write_json(folder / "scene.json", {"scale": 0.5, "center": [0, 0, 0], "near": 0.5, "far": 8})
    for i, path in enumerate(sorted((folder / "camera").glob("*.json"))):
        straight = np.eye(3).tolist()
        edit(path, lambda c, i=i, r=straight: c.update(orientation=r, position=[0.1 * i, 0, 0]))
    views = {view.name: view.camera for view in read_scene(folder).views}
    # all cameras lie in one plane, 4 before the middle, which comes to be the origin
    for i, camera in enumerate(views[f"{i:06d}"] for i in range(9)):
        np.testing.assert_allclose(camera.translation, [0.4 - 0.1 * i, 0, 4.0], atol=1e-6)


def write(name: str, change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda folder: edit(folder / name, change)


def camera(**fields: Any) -> Callable[[Path], None]:
    return write("camera/000003.json", lambda document: document.update(fields))


def without(name: str, key: str) -> Callable[[Path], None]:
    return write(name, lambda document: document.pop(key))


def points(array: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / "points.npy", array)


CAMERA = "camera/000003.json"
BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no frames": (write("dataset.json", lambda d: d.update(ids=[], train_ids=[], val_ids=[])),
                  "no train frames"),
    "ids not a list": (write("dataset.json", lambda d: d.update(ids=3)), "ids: 3 found where"),
    "an id not a name": (write("dataset.json", lambda d: d.update(ids=[3])), "3 found where a fr"),
    "a strange id": (write("dataset.json", lambda d: d["val_ids"].append("x")), "'x' is not among"),
    "no metadata": (lambda f: (f / "metadata.json").unlink(), r"metadata\.json cannot be read"),
    "no entry": (without("metadata.json", "000003"), "'000003' is missing"),
    "no time": (write("metadata.json", lambda d: d["000003"].clear()), "warp_id is None"),
    "a time below 0": (write("metadata.json", lambda d: d["000003"].update(time_id=-1)),
                       "time_id is -1; it must be 0 or more"),
    "no camera": (lambda f: (f / CAMERA).unlink(), r"000003\.json does not exist; restore it"),
    "no focal length": (without(CAMERA, "focal_length"), "focal_length is None"),
    "focal length 0": (camera(focal_length=0), "focal_length is 0.0; it must be above 0"),
    "aspect 0": (camera(pixel_aspect_ratio=0), "pixel_aspect_ratio is 0.0"),
    "no principal point": (without(CAMERA, "principal_point"), "principal_point: None found"),
    "two radial terms": (camera(radial_distortion=[0, 0]), "holds 2 entries; it must hold 3"),
    "no orientation": (without(CAMERA, "orientation"), "orientation: None found where"),
    "a stretched orientation": (camera(orientation=(2 * np.eye(3)).tolist()), "scaled by 2"),
    "a flat orientation": (camera(orientation=[1, 2, 3]), "JSON list"),
    "no position": (without(CAMERA, "position"), "position: None found"),
    "a position nowhere": (camera(position=[0, math.nan, 0]), "nan; it must be a finite number"),
    "half a pixel": (camera(image_size=[40.5, 64]), "40.5; it must be a whole number"),
    "another shape": (camera(image_size=[40, 40]), "20 x 32 px, but its camera's size is 40 x 40"),
    "no pictures": (lambda f: (f / "rgb").rename(f / "pictures"), "no pictures; looked for rgb/2x"),
    "no picture": (lambda f: (f / "rgb/2x/000003.png").unlink(), "000003 does not exist"),
    "a larger picture": (
        lambda f: write_picture(f / "rgb/2x/000003.png", noise(64, 40, 3)), "all frames must have"),
    "depth 0": (write("scene.json", lambda d: d.update(near=0)), "near is 0.0"),
    "points in a plane": (points(np.zeros((5, 2))), r"shape \(5, 2\)"),
    "points of text": (points(np.full((5, 3), "a")), "its entries are of the type <U1"),
    "pickled points": (points(np.full((5, 3), None)), r"points\.npy: is damaged"),
    "torn points": (lambda f: (f / "points.npy").write_bytes(b"\x93NUMPY"), "is damaged"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(
    folder: Path, spoil: Callable[[Path], Any], message: str
) -> None:
    spoil(folder)
    assert_refused(folder, message)


def test_the_fingerprint_follows_cameras_and_splits(folder: Path) -> None:
    def again() -> str:
        return read_scene(folder).fingerprint

    first = again()
    assert again() == first
    camera(focal_length=51.0)(folder)
    second = again()
    edit(folder / "dataset.json", lambda d: d["val_ids"].pop())
    assert len({first, second, again()}) == 3


def normalized_axes(scene: Scene) -> np.ndarray:
    return np.stack([view.camera.rotation[2] for view in scene.split("train")])


def test_a_real_capture(shared_data: Path) -> None:
    scene = read_scene(shared_data / "nerfies" / "cake")
    assert [len(scene.split(s)) for s in ("train", "test")] == [82, 5]
    assert scene.train_times[0] == 0 and scene.train_times[-1] == 1
    view = scene.views[0]
    assert (view.camera.width, view.camera.height) == (240, 428)
    assert view.lens is not None and view.lens.fx == pytest.approx(716.3578 / 2, rel=1e-6)
    # walking round a cake, all cameras have it before them
    towards = np.stack([-v.camera.centre for v in scene.split("train")])
    assert (np.einsum("vi,vi->v", towards, normalized_axes(scene)) > 1).all()
    assert 2 < scene.radius < 8
