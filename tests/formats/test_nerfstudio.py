"""The reader of nerfstudio's layout, and of the scene folder that ``prepare`` writes."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import noise, pose, write_json, write_picture
from refusals import assert_refused

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene

POINTS = np.random.default_rng(5).normal(size=(60, 3)) * 0.3
COLOURS = np.random.default_rng(6).integers(0, 256, (60, 3))


def write_ply(path: Path, coloured: bool = True) -> None:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(POINTS)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {c}" for c in ("red", "green", "blue")] if coloured else []
    rows = [
        " ".join(map(repr, map(float, point))) + (" {} {} {}".format(*colour) if coloured else "")
        for point, colour in zip(POINTS, COLOURS, strict=True)
    ]
    path.write_text("\n".join([*lines, "end_header", *rows]))


def write_scene(folder: Path, count: int = 10) -> Path:
    frames = []
    for i in range(count):
        write_picture(folder / "images" / f"f{i}.png", noise(16, 20, 3, seed=i))
        frames.append(
            {
                "file_path": f"images/f{i}.png",
                "transform_matrix": pose(azimuth=0.4 * i),
                "time": i / (count - 1),
            }
        )
    document = {
        "camera_model": "OPENCV",
        "fl_x": 25.0, "fl_y": 26.0, "cx": 10.5, "cy": 7.5, "w": 20, "h": 16,
        "frames": frames,
        "ply_file_path": "points.ply",
    }  # fmt: skip
    write_json(folder / "transforms.json", document)
    write_ply(folder / "points.ply")
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "scene")


def edit(folder: Path, change: Callable[[dict[str, Any]], Any]) -> Scene:
    path = folder / "transforms.json"
    document = json.loads(path.read_text())
    change(document)
    write_json(path, document)
    return read_scene(folder)


def test_a_scene_is_read_and_declared(folder: Path) -> None:
    scene = read_scene(folder)
    assert scene.layout == "nerfstudio" and scene.duration is None
    assert [view.name for view in scene.split("test")] == ["f0", "f8"]
    assert [view.time for view in scene.split("test")] == [0, pytest.approx(8 / 9)]
    assert len(scene.split("train")) == 8
    camera = scene.views[3].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (25, 26, 10.5, 7.5)
    assert scene.colours is not None
    np.testing.assert_allclose(scene.colours, COLOURS / 255, atol=1e-6)
    # similar figures: distances between cameras and points keep their proportions
    centre = np.array(pose(azimuth=1.2))[:3, 3]
    before = np.linalg.norm(centre - POINTS, axis=1)
    after = np.linalg.norm(camera.centre - scene.points, axis=1)
    np.testing.assert_allclose(after / before, (after / before)[0], rtol=1e-5)
    middle = np.median(scene.points, axis=0)
    np.testing.assert_allclose(middle, 0, atol=0.2)


def test_points_project_as_blenders_axes_say(folder: Path) -> None:
    scene = read_scene(folder)
    matrix = np.array(pose(azimuth=0.4 * 5))
    x, y, z = (np.linalg.inv(matrix) @ [*POINTS[7], 1])[:3]  # x right, y up, z backward
    expected = (10.5 + 25 * x / -z, 7.5 - 26 * y / -z)
    camera = next(view for view in scene.views if view.name == "f5").camera
    x, y, z = camera.rotation @ scene.points[7] + camera.translation
    found = camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z
    assert found == pytest.approx(expected, abs=1e-4)


def test_what_prepare_has_declared_stays_where_it_is(folder: Path) -> None:
    about = {"gsdmsr": 1, "bound": 2.5, "duration": 4.0}
    write_json(folder / "scene.json", about)
    scene = read_scene(folder)
    assert scene.bound == 2.5 and scene.duration == 4.0
    np.testing.assert_allclose(scene.points, POINTS, atol=1e-6)
    centres = [view.camera.centre for view in scene.views]
    np.testing.assert_allclose(centres[2], np.array(pose(azimuth=0.8))[:3, 3], atol=1e-12)


def test_another_tools_scene_file_declares_nothing(folder: Path) -> None:
    before = read_scene(folder)
    write_json(folder / "scene.json", {"bound": 2.5})
    assert read_scene(folder).bound == before.bound != 2.5


def test_lists_of_frames_are_the_splits(folder: Path) -> None:
    def lists(document: dict[str, Any]) -> None:
        names = [frame["file_path"] for frame in document["frames"]]
        document.update(
            train_filenames=names[:5], val_filenames=names[5:6], test_filenames=names[6:8]
        )

    scene = edit(folder, lists)
    found = {s: [v.name for v in scene.views if v.split == s] for s in ("train", "val", "test")}
    assert found == {"train": ["f0", "f1", "f2", "f3", "f4"], "val": ["f5"], "test": ["f6", "f7"]}


def test_frames_without_times_were_taken_evenly(folder: Path) -> None:
    scene = edit(folder, lambda d: [frame.pop("time") for frame in d["frames"]])
    assert [view.time for view in scene.views] == pytest.approx([i / 9 for i in range(10)])


def test_a_single_frame_is_for_training(folder: Path) -> None:
    scene = edit(folder, lambda d: d["frames"].__delitem__(slice(1, None)))
    assert [(view.split, view.time) for view in scene.views] == [("train", 0)]


def test_a_lens_is_undone(folder: Path) -> None:
    scene = edit(folder, lambda d: d.update(k1=0.1, p1=0.01))
    lens = scene.views[0].lens
    assert lens is not None and lens.radial[0] == 0.1 and lens.tangential == (0.01, 0)
    assert Pictures((1.0, 1.0, 1.0), 1, 1 << 20).load(scene.views[0]).shape == (3, 16, 20)


def test_masks_of_what_counts_and_of_what_moves(folder: Path) -> None:
    mask = np.zeros((16, 20, 1), np.uint8)
    mask[3:9, 4:15] = 255
    write_picture(folder / "masks" / "m.png", mask)
    write_picture(folder / "moving" / "m.png", 255 - mask)

    def name(document: dict[str, Any]) -> None:
        document["frames"][1].update(mask_path="masks/m.png", motion_mask_path="moving/m.png")
        document["frames"][2].update(mask_path=None)

    first, second, third = edit(folder, name).views[:3]
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 20)
    for view in (first, third):
        assert not view.signals
    counted, moving = (pictures.signal(second, name) for name in ("mask", "moving"))
    assert counted is not None and moving is not None
    assert (counted.numpy() == (mask[..., 0] > 0)).all() and (moving.numpy() == ~counted).all()


def test_points_may_have_no_colours_and_scenes_no_points(folder: Path) -> None:
    write_ply(folder / "points.ply", coloured=False)
    scene = read_scene(folder)
    assert len(scene.points) == len(POINTS) and scene.colours is None
    scene = edit(folder, lambda d: d.pop("ply_file_path"))
    assert scene.points.shape == (0, 3)
    for view in scene.views:  # all face the origin, from one distance
        np.testing.assert_allclose(view.camera.translation, [0, 0, 4], atol=1e-3)


def test_folders_of_d_nerf_are_d_nerfs(folder: Path) -> None:
    document = json.loads((folder / "transforms.json").read_text())
    write_json(folder / "transforms_train.json", document)
    assert read_scene(folder).layout == "dnerf"


def frame(**fields: Any) -> Callable[[Path], None]:
    return lambda folder: change(folder, lambda d: d["frames"][1].update(fields))


def change(folder: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads((folder / "transforms.json").read_text())
    edit(document)
    write_json(folder / "transforms.json", document)


def top(edit: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    return lambda folder: change(folder, edit)


def declared(**fields: Any) -> Callable[[Path], None]:
    return lambda folder: write_json(folder / "scene.json", {"gsdmsr": 1, **fields})


def small_mask(folder: Path) -> None:
    write_picture(folder / "mask.png", noise(8, 8, 1))
    frame(mask_path="mask.png")(folder)


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no frames": (top(lambda d: d.pop("frames")), "frames: None found"),
    "empty frames": (top(lambda d: d.update(frames=[])), "no train frames"),
    "no file_path": (top(lambda d: d["frames"][1].pop("file_path")), "frame 1: no 'file_path'"),
    "a picture gone": (frame(file_path="images/gone.png"), "gone.png does not exist"),
    "one time missing": (top(lambda d: d["frames"][1].pop("time")), "time is None"),
    "time in seconds": (frame(time=3.5), r"time is 3\.5; it must lie in \[0, 1\]"),
    "a model unknown": (top(lambda d: d.update(camera_model="EQUIRECTANGULAR")), "camera_model is"),
    "a list of strangers": (top(lambda d: d.update(test_filenames=["x.png"])), "'x.png' is the"),
    "nothing to train on": (top(lambda d: d.update(train_filenames=[])), "no train frames"),
    "mask gone": (frame(mask_path="masks/gone.png"), "mask_path: image .*gone.png does not exist"),
    "mask outside": (frame(motion_mask_path="../m.png"), "leads out of"),
    "mask of another size": (small_mask, r"mask\.png is 8 x 8 px, but .*f1\.png is 20 x 16"),
    "points gone": (lambda f: (f / "points.ply").unlink(), r"points\.ply does not exist; restore"),
    "points outside": (top(lambda d: d.update(ply_file_path="../p.ply")), "leads out of"),
    "points a number": (top(lambda d: d.update(ply_file_path=3)), "it must name a file"),
    "points no PLY": (lambda f: (f / "points.ply").write_text("hello"), "is not a PLY file"),
    "no bound": (declared(), "bound is None"),
    "bound 0": (declared(bound=0), "bound is 0.0; it must be above 0"),
    "duration NaN": (declared(bound=1, duration=math.nan), "duration is nan"),
}


@pytest.mark.parametrize(("spoil", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(
    folder: Path, spoil: Callable[[Path], Any], message: str
) -> None:
    spoil(folder)
    assert_refused(folder, message)


def test_points_without_positions_are_refused(folder: Path) -> None:
    path = folder / "points.ply"
    path.write_text(path.read_text().replace("property float y", "property float why"))
    with pytest.raises(DataError, match=r"points\.ply: its vertices have no y"):
        read_scene(folder)
