"""The D-NeRF reader: every variant it takes, every input it refuses, and its axes."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import dnerf_frames, noise, pose, write_dnerf, write_json, write_picture
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.formats._transforms import world_to_camera
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.scene import Scene

Edit = Callable[[dict[str, Any]], None]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_dnerf(tmp_path / "scene")


def edit_train(folder: Path, edit: Edit) -> None:
    path = folder / "transforms_train.json"
    document = json.loads(path.read_text())
    edit(document)
    write_json(path, document)


def edited(folder: Path, edit: Edit) -> Scene:
    edit_train(folder, edit)
    return read_scene(folder)


def test_a_scene_is_read(folder: Path) -> None:
    scene = read_scene(folder)
    assert scene.layout == "dnerf" and scene.root == folder
    assert [len(scene.split(s)) for s in ("train", "val", "test")] == [3, 2, 2]
    assert scene.points.shape == (0, 3) and scene.colours is None
    assert scene.duration is None and scene.bound == 1.3
    assert scene.train_times == [0.0, 0.5, 1.0]
    view = scene.split("train")[1]
    assert view.name == "r_001" and view.image_path == folder / "train" / "r_001.png"
    camera = view.camera
    assert (camera.width, camera.height, camera.cx, camera.cy) == (10, 8, 5, 4)
    assert camera.fx == camera.fy == pytest.approx(0.5 * 10 / math.tan(0.35))
    np.testing.assert_allclose(camera.centre, np.array(pose(azimuth=0.7))[:3, 3], atol=1e-12)


def test_the_fingerprint_is_of_the_json_files(folder: Path) -> None:
    files = [folder / f"transforms_{s}.json" for s in ("train", "val", "test")]
    digest = hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest()
    assert read_scene(folder).fingerprint == digest[:16]
    edit_train(folder, lambda d: d["frames"][0].update(time=0.25))
    assert read_scene(folder).fingerprint != digest[:16]


@pytest.mark.parametrize("missing", ["val", "test"])
def test_val_or_test_may_be_missing(folder: Path, missing: str) -> None:
    (folder / f"transforms_{missing}.json").unlink()
    scene = read_scene(folder)
    assert {view.split for view in scene.views} == {"train", "val", "test"} - {missing}


@pytest.mark.parametrize("written", ["./train/x", "train/x", ".\\train\\x", "train/sub/../x"])
@pytest.mark.parametrize("extension", [".png", ".jpg", ".jpeg"])
@pytest.mark.parametrize("named", [True, False])
def test_file_paths_in_all_spellings(
    folder: Path, written: str, extension: str, named: bool
) -> None:
    (folder / "train" / "sub").mkdir()
    write_picture(folder / "train" / f"x{extension}", noise(8, 10, 3))
    text = written + extension if named else written
    scene = edited(folder, lambda d: d["frames"][0].update(file_path=text))
    path = scene.split("train")[0].image_path
    assert path.resolve() == (folder / "train" / f"x{extension}").resolve()


def test_a_dot_in_a_name_is_no_extension(folder: Path) -> None:
    write_picture(folder / "train" / "t0.5.png", noise(8, 10, 3))
    scene = edited(folder, lambda d: d["frames"][0].update(file_path="train/t0.5"))
    assert scene.split("train")[0].name == "t0.5"


def test_repeated_names_are_made_unique(folder: Path) -> None:
    write_picture(folder / "train" / "r_001_2.png", noise(8, 10))

    def edit(document: dict[str, Any]) -> None:
        for frame, name in zip(document["frames"], ("r_001", "r_001", "r_001_2"), strict=True):
            frame["file_path"] = f"train/{name}"

    names = [view.name for view in edited(folder, edit).split("train")]
    assert names == ["r_001", "r_001_3", "r_001_2"]


def test_intrinsics_in_pixels_for_all_and_for_one(folder: Path) -> None:
    def edit(document: dict[str, Any]) -> None:
        document.update(fl_x=30.0, fl_y=31.0, cx=5.5, cy=3.5, w=10, h=8)
        document["frames"][1].update(fl_x=40.0, cx=4.5)

    first, second, _ = (view.camera for view in edited(folder, edit).split("train"))
    assert (first.fx, first.fy, first.cx, first.cy) == (30, 31, 5.5, 3.5)
    assert (second.fx, second.fy, second.cx, second.cy) == (40, 31, 4.5, 3.5)


def test_intrinsics_of_larger_pictures_are_scaled(folder: Path) -> None:
    def edit(document: dict[str, Any]) -> None:
        del document["camera_angle_x"]
        document.update(fl_x=60.0, cx=11.0, cy=8.0, w=20, h=16)

    camera = edited(folder, edit).split("train")[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 30, 5.5, 4)
    assert (camera.width, camera.height) == (10, 8)


def test_a_vertical_angle_of_its_own(folder: Path) -> None:
    camera = edited(folder, lambda d: d.update(camera_angle_y=0.5)).split("train")[0].camera
    assert camera.fy == pytest.approx(0.5 * 8 / math.tan(0.25))


def test_a_lens_of_all_frames_or_of_one(folder: Path) -> None:
    def edit(document: dict[str, Any]) -> None:
        document.update(k1=0.1, k2=-0.02, p1=0.003, p2=0.004, k3=0.005, k4=0.0)
        document["frames"][1].update(camera_model="OPENCV_FISHEYE", k4=0.01)
        document["frames"][2].update(camera_model="PINHOLE")

    first, second, third = (view.lens for view in edited(folder, edit).split("train"))
    assert first is not None and second is not None and third is None
    assert first.radial == (0.1, -0.02, 0.005) and first.tangential == (0.003, 0.004)
    assert second.radial == (0.1, -0.02, 0.005, 0.01) and second.fisheye and not first.fisheye


def nvfi_camera(frames: list[dict[str, Any]]) -> dict[str, Any]:
    keys = ("file_path", "time")
    return {
        "transform_matrix": pose(azimuth=2.0),
        "frames": [{key: frame[key] for key in keys} for frame in frames],
    }


@pytest.mark.parametrize("layout", ["data", "frames"])
def test_nvfi_frames_inside_of_cameras(folder: Path, layout: str) -> None:
    camera = nvfi_camera(dnerf_frames("train", 3))
    entries: Any = {"cam0": camera} if layout == "data" else [camera]
    write_json(folder / "transforms_train.json", {"camera_angle_x": 0.7, layout: entries})
    views = read_scene(folder).split("train")
    assert [view.time for view in views] == [0, 0.5, 1]
    for view in views:
        np.testing.assert_allclose(view.camera.centre, np.array(pose(azimuth=2.0))[:3, 3])


def test_nvfi_frames_without_times_are_evenly_spaced(folder: Path) -> None:
    camera = nvfi_camera(dnerf_frames("train", 3))
    for frame in camera["frames"]:
        del frame["time"]
    document = {"camera_angle_x": 0.7, "data": {"cam0": camera}}
    write_json(folder / "transforms_train.json", document)
    assert [view.time for view in read_scene(folder).split("train")] == [0, 0.5, 1]


def frame(**fields: Any) -> Edit:
    return lambda document: document["frames"][1].update(fields)


def without(key: str) -> Edit:
    return lambda document: document["frames"][1].pop(key)


def matrix(change: Callable[[np.ndarray], Any]) -> Edit:
    """Replace the second frame's pose by what ``change`` makes of it."""

    def edit(document: dict[str, Any]) -> None:
        changed = np.array(document["frames"][1]["transform_matrix"])
        result = change(changed)
        document["frames"][1]["transform_matrix"] = np.asarray(
            changed if result is None else result
        ).tolist()

    return edit


def scaled(pose: np.ndarray) -> None:
    pose[:3, :3] *= 2


def mirrored(pose: np.ndarray) -> None:
    pose[:3, 0] *= -1


def sheared(pose: np.ndarray) -> None:
    pose[:3, 0] += 0.01 * pose[:3, 1]


def collapsed(pose: np.ndarray) -> None:
    pose[:3, :3] = 0


def with_nan(pose: np.ndarray) -> None:
    pose[0, 3] = np.nan


def with_perspective(pose: np.ndarray) -> None:
    pose[3, 2] = 1


BAD: dict[str, tuple[Edit, str]] = {
    "no frames": (lambda d: d["frames"].clear(), "no train frames"),
    "no frames key": (lambda d: d.pop("frames"), "neither 'frames' nor 'data'"),
    "frames not a list": (lambda d: d.update(frames=3), r"3 found where a JSON list"),
    "frame not an object": (
        lambda d: d.update(frames=["a"]),
        r"frame 0: 'a' found where a JSON obj",
    ),
    "data not an object": (
        lambda d: (d.pop("frames"), d.update(data=[1])),
        r"\[1\] found where a JSON object",
    ),
    "no file_path": (without("file_path"), "frame 1: no 'file_path'"),
    "file_path a number": (frame(file_path=7), "file_path is 7"),
    "file_path empty": (frame(file_path=""), "file_path is ''"),
    "file_path missing": (frame(file_path="train/gone"), r"image .*gone does not exist"),
    "file_path up": (frame(file_path="../outside"), "leads out of"),
    "file_path up, backslashes": (frame(file_path="..\\outside.png"), "leads out of"),
    "file_path absolute": (frame(file_path="/etc/hostname"), "must be relative"),
    "file_path with drive": (frame(file_path="C:\\a.png"), "must be relative"),
    "file_path with null byte": (frame(file_path="a\0b"), "not a usable path"),
    "file_path too long": (frame(file_path="a" * 5000), "not a usable path"),
    "file_path a link out": (frame(file_path="train/link"), "leads out of"),
    "no time": (without("time"), r"frame 1 \(\./train/r_001\): no 'time'"),
    "time above": (frame(time=1.5), r"frame 1 \(\./train/r_001\): time is 1\.5; .*\[0, 1\]"),
    "time below": (frame(time=-0.1), r"time is -0\.1; .*\[0, 1\]"),
    "time NaN": (frame(time=math.nan), "time is nan; it must be a finite number"),
    "time a string": (frame(time="0.5"), "time is '0.5'; it must be a finite number"),
    "time null": (frame(time=None), "time is None; it must be a finite number"),
    "time a bool": (frame(time=True), "time is True; it must be a finite number"),
    "time huge": (frame(time=10**400), "it must be a finite number"),
    "no matrix": (without("transform_matrix"), "no 'transform_matrix'"),
    "matrix a string": (frame(transform_matrix="x"), "JSON list"),
    "matrix 3x4": (matrix(lambda m: m[:3]), "not 4 x 4"),
    "matrix ragged": (frame(transform_matrix=[[1, 0, 0, 0], [0, 1]]), "not 4 x 4"),
    "matrix flat": (matrix(np.ravel), "JSON list"),
    "matrix of strings": (frame(transform_matrix=[["1"] * 4] * 4), "finite number"),
    "matrix NaN": (matrix(with_nan), "nan; it must be a finite number"),
    "matrix scaled": (matrix(scaled), "rotation is scaled by 2;"),
    "matrix mirrored": (matrix(mirrored), "mirrors"),
    "matrix sheared": (matrix(sheared), "not orthonormal"),
    "matrix zero": (matrix(collapsed), "not orthonormal"),
    "matrix projective": (matrix(with_perspective), "last row"),
    "no angle": (lambda d: d.pop("camera_angle_x"), "no 'camera_angle_x' and no 'fl_x'"),
    "angle zero": (lambda d: d.update(camera_angle_x=0), r"\(0, pi\)"),
    "angle pi": (lambda d: d.update(camera_angle_x=math.pi), r"\(0, pi\)"),
    "angle in degrees": (lambda d: d.update(camera_angle_x=40), r"camera_angle_x is 40"),
    "angle a string": (lambda d: d.update(camera_angle_x="a"), "camera_angle_x is 'a'"),
    "vertical angle": (lambda d: d.update(camera_angle_y=-1), "camera_angle_y is -1"),
    "focal zero": (lambda d: d.update(fl_x=0), "fl_x is 0.0; it must be above 0"),
    "centre a list": (lambda d: d.update(cx=[]), r"cx is \[\]"),
    "width half": (lambda d: d.update(w=10.5), "w is 10.5; it must be a whole number"),
    "width zero": (lambda d: d.update(w=0), "w is 0; it must be a whole number"),
    "other aspect": (lambda d: d.update(w=10, h=10), "10 x 8 px, but its camera's size is 10 x 10"),
    "distortion of another model": (lambda d: d.update(k4=0.1), r"k4 is 0\.1; it must be 0"),
    "a camera unknown": (
        lambda d: d.update(camera_model="ORTHO"),
        r"camera_model is 'ORTHO'; it must be one of SIMPLE_PINHOLE",
    ),
    "another size": (frame(file_path="train/large"), "10 x 8; all frames must have one size"),
    "a truncated image": (frame(file_path="train/cut"), r"cut\.png is damaged"),
    "no image": (frame(file_path="train/text.png"), r"text\.png is damaged or not a picture"),
}


@pytest.mark.parametrize(("edit", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(folder: Path, edit: Edit, message: str) -> None:
    write_picture(folder.parent / "outside.png", noise(8, 10))
    write_picture(folder / "train" / "large.png", noise(16, 20))
    (folder / "train" / "link.png").symlink_to(folder.parent / "outside.png")
    whole = (folder / "train" / "r_000.png").read_bytes()
    (folder / "train" / "cut.png").write_bytes(whole[: len(whole) // 2])
    (folder / "train" / "text.png").write_text("hello")
    edit_train(folder, edit)
    with pytest.raises(DataError, match=message) as error:
        read_scene(folder)
    assert "\n" not in str(error.value)
    assert str(folder) in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"frames": [\n  {"time": 0,}]}', r"malformed JSON at line 2, column 1\d"),
        (b"", "malformed JSON at line 1, column 1"),
        (b"\xff\xfe{}", "malformed JSON"),
        (b"[" * 100_000, "malformed JSON"),
        (b"[1, 2]", "JSON object"),
    ],
)
def test_malformed_json_is_refused_in_one_line(folder: Path, content: bytes, message: str) -> None:
    path = folder / "transforms_val.json"
    path.write_bytes(content)
    with pytest.raises(DataError, match=message) as error:
        read_scene(folder)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_train_must_be_there(folder: Path) -> None:
    (folder / "transforms_train.json").unlink()
    with pytest.raises(DataError, match=r"no transforms_train\.json; found transforms_val\.json"):
        read_scene(folder)


def test_a_missing_folder_a_file_and_an_unknown_layout(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="gone does not exist"):
        read_scene(tmp_path / "gone")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(DataError, match="is a file, not a folder"):
        read_scene(tmp_path / "notes.txt")
    with pytest.raises(DataError, match=r"found notes\.txt; known: .*dnerf \(transforms_train"):
        read_scene(tmp_path)


ANGLES = st.floats(-math.pi, math.pi)
OFFSETS = st.tuples(*[st.floats(-1, 1)] * 3)


@given(azimuth=ANGLES, elevation=st.floats(-1.4, 1.4), roll=ANGLES, point=OFFSETS, shift=OFFSETS)
def test_axes_agree_with_an_opengl_pinhole(
    azimuth: float,
    elevation: float,
    roll: float,
    point: tuple[float, float, float],
    shift: tuple[float, float, float],
) -> None:
    """Blender: x right, y up, looking along -z; pixel rows count downwards from the top left."""
    spin = np.eye(4)
    spin[:2, :2] = [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]
    camera_to_world = np.array(pose(azimuth, elevation)) @ spin
    camera_to_world[:3, 3] += shift
    # Relative to the camera: at most 1 beside its axis and 2 to 4 in front of it.
    local = np.array([point[0], point[1], -3 + point[2]])
    world = camera_to_world[:3, :3] @ local + camera_to_world[:3, 3]
    focal, cx, cy = 50.0, 20.0, 15.0
    u = cx + focal * local[0] / -local[2]
    v = cy - focal * local[1] / -local[2]

    x, y, z = (world_to_camera(camera_to_world) @ [*world, 1])[:3]
    assert z == pytest.approx(-local[2])
    assert focal * x / z + cx == pytest.approx(u, abs=1e-9)
    assert focal * y / z + cy == pytest.approx(v, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("bouncingballs", [150, 20, 20]),
        ("jumpingjacks", [200, 20, 20]),
        ("hook", [100, 20, 20]),
        ("lego", [50, 11, 20]),
    ],
)
def test_published_scenes(shared_data: Path, name: str, counts: list[int]) -> None:
    scene = read_scene(shared_data / "dnerf" / name)
    assert [len(scene.split(s)) for s in ("train", "val", "test")] == counts
    assert scene.train_times[0] == 0 and scene.train_times[-1] == 1
    assert 4 < scene.radius < 6
    for view in scene.views:
        assert (view.camera.width, view.camera.height) == (800, 800)
        # Every camera looks at the origin from 4 units away (METHODS 0.9).
        x, y, z = view.camera.translation
        assert abs(x / z) < 0.3 and abs(y / z) < 0.3 and 3 < z < 5
