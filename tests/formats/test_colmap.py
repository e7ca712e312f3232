"""The reader of COLMAP models, against pycolmap's own projection and files written byte by byte."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import noise, write_json, write_picture
from refusals import assert_refused

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.formats.colmap import times_by_name
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import imaging  # noqa: F401  (before pycolmap, see there)

MODELS: dict[str, tuple[int, list[float]]] = {
    "SIMPLE_PINHOLE": (0, [50.0, 19.0, 33.0]),
    "PINHOLE": (1, [50.0, 52.0, 19.0, 33.0]),
    "SIMPLE_RADIAL": (2, [50.0, 19.0, 33.0, 0.1]),
    "RADIAL": (3, [50.0, 19.0, 33.0, 0.1, -0.02]),
    "OPENCV": (4, [50.0, 52.0, 19.0, 33.0, 0.1, -0.02, 0.003, 0.004]),
    "OPENCV_FISHEYE": (5, [50.0, 52.0, 19.0, 33.0, 0.1, -0.02, 0.003, 0.004]),
    "FULL_OPENCV": (6, [50.0, 52.0, 19.0, 33.0, 0.1, -0.02, 0.003, 0.004, 0.01, 0.2, 0.03, 0.01]),
    "SIMPLE_RADIAL_FISHEYE": (8, [50.0, 19.0, 33.0, 0.1]),
    "RADIAL_FISHEYE": (9, [50.0, 19.0, 33.0, 0.1, -0.02]),
    "SIMPLE_FISHEYE": (14, [50.0, 19.0, 33.0]),
    "FISHEYE": (15, [50.0, 52.0, 19.0, 33.0]),
}
COUNT = 9
POINTS = np.random.default_rng(3).normal(size=(80, 3)) * 0.3 + [0.0, 0.0, 4.0]
COLOURS = np.random.default_rng(4).integers(0, 256, (80, 3))


AXIS = np.array([0.48, 0.6, 0.64])
"""Of unit length, and of no two coordinates alike."""


def quaternion(i: int) -> list[float]:
    """A turn of i / 25 about ``AXIS``, wxyz, of a length of its own."""
    half = i / 50
    return [(0.5 + i) * float(part) for part in (np.cos(half), *(np.sin(half) * AXIS))]


def rotation(i: int) -> np.ndarray:
    """That turn, by the formula of Rodrigues."""
    x, y, z = AXIS
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = i / 25
    return np.eye(3) + np.sin(angle) * across + (1 - np.cos(angle)) * across @ across


def translation(i: int) -> list[float]:
    return [0.1 * i, -0.05 * i, 0.2]


def write_binary(folder: Path, model: str = "OPENCV", tracks: int = 3) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    number, parameters = MODELS[model]
    camera = struct.pack("<QiiQQ", 1, 7, number, 40, 64)
    (folder / "cameras.bin").write_bytes(camera + struct.pack(f"<{len(parameters)}d", *parameters))
    images = struct.pack("<Q", COUNT)
    for i in reversed(range(COUNT)):  # in an order of its own
        images += struct.pack("<i7di", i + 1, *quaternion(i), *translation(i), 7)
        images += f"f{i:03d}.png".encode() + b"\0" + struct.pack("<Q", COUNT - i)
        images += b"".join(struct.pack("<ddq", 1.0, 2.0, -1) for _ in range(COUNT - i))
    (folder / "images.bin").write_bytes(images)
    points = struct.pack("<Q", len(POINTS))
    for i, (point, colour) in enumerate(zip(POINTS, COLOURS, strict=True)):
        points += struct.pack("<Q3d3BdQ", i, *point, *map(int, colour), 0.5, i % tracks)
        points += b"".join(struct.pack("<ii", 9, 2) for _ in range(i % tracks))
    (folder / "points3D.bin").write_bytes(points)


def write_text(folder: Path, model: str = "OPENCV") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    parameters = " ".join(map(repr, MODELS[model][1]))
    (folder / "cameras.txt").write_text(f"# Camera list\n7 {model} 40 64 {parameters}\n")
    lines = ["# Image list", "#   IMAGE_ID, QW, ..."]
    for i in reversed(range(COUNT)):
        numbers = " ".join(map(repr, quaternion(i) + translation(i)))
        lines += [f"{i + 1} {numbers} 7 f{i:03d}.png", "1.0 2.0 -1 " * i]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [
        f"{i} {' '.join(map(repr, map(float, point)))} {' '.join(map(str, colour))} 0.5 1 2"
        for i, (point, colour) in enumerate(zip(POINTS, COLOURS, strict=True))
    ]
    (folder / "points3D.txt").write_text("\n".join(["# Points", *rows]))


def write_pictures(folder: Path, scale: int = 1) -> None:
    for i in range(COUNT):
        write_picture(folder / f"f{i:03d}.png", noise(64 // scale, 40 // scale, 3, seed=i))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_binary(tmp_path / "scene" / "sparse" / "0")
    write_pictures(tmp_path / "scene" / "images")
    return tmp_path / "scene"


@pytest.mark.parametrize("write", [write_binary, write_text])
@pytest.mark.parametrize("model", MODELS)
def test_points_fall_where_colmap_projects_them(
    tmp_path: Path, model: str, write: Callable[[Path, str], None]
) -> None:
    import pycolmap

    write(tmp_path / "sparse", model)
    write_pictures(tmp_path / "images")
    scene = read_scene(tmp_path)
    assert scene.layout == "colmap"
    number, parameters = MODELS[model]
    camera = pycolmap.Camera(model=model, width=40, height=64, params=parameters)
    assert int(camera.model) == number
    for i, view in enumerate(scene.views):
        assert view.name == f"f{i:03d}"
        np.testing.assert_allclose(view.camera.rotation, rotation(i), atol=1e-9)
        local = POINTS @ rotation(i).T + translation(i)
        expected = camera.img_from_cam(local)
        normalized = scene.points @ view.camera.rotation.T + view.camera.translation
        x, y = (normalized[:, :2] / normalized[:, 2:]).T
        if view.lens is None:
            c = view.camera
            found = np.stack([c.fx * x + c.cx, c.fy * y + c.cy], 1)
        else:
            found = np.stack(view.lens.project(x, y), 1)
        np.testing.assert_allclose(found, expected, atol=1e-3)
    assert (scene.views[0].lens is None) == model.endswith("PINHOLE")


def test_a_model_that_pycolmap_writes_is_read(tmp_path: Path) -> None:
    import pycolmap

    write_binary(tmp_path / "a" / "sparse" / "0", tracks=1)  # tracks of no length: it checks them
    model = pycolmap.Reconstruction(tmp_path / "a" / "sparse" / "0")
    for kind in ("binary", "text"):
        target = tmp_path / kind / "sparse"
        target.mkdir(parents=True)
        getattr(model, f"write_{kind}")(target)
        write_pictures(tmp_path / kind / "input")
        scene = read_scene(tmp_path / kind)
        assert len(scene.views) == COUNT and len(scene.points) == len(POINTS)
        assert scene.views[4].camera.fx == pytest.approx(scene.views[0].camera.fx)


def test_splits_times_points_and_colours(folder: Path) -> None:
    scene = read_scene(folder)
    assert [view.name for view in scene.split("test")] == ["f000", "f008"]
    assert [view.time for view in scene.views] == [i / 8 for i in range(COUNT)]
    assert scene.colours is not None
    np.testing.assert_allclose(scene.colours, COLOURS / 255, atol=1e-6)
    before = np.linalg.norm(POINTS[1:] - POINTS[0], axis=1)
    after = np.linalg.norm(scene.points[1:] - scene.points[0], axis=1)
    np.testing.assert_allclose(after / before, (after / before)[0], rtol=1e-4)


def test_pictures_may_have_been_shrunk(folder: Path) -> None:
    whole = read_scene(folder).views[3].camera
    write_pictures(folder / "images", scale=2)
    half = read_scene(folder).views[3].camera
    assert (half.width, half.height) == (20, 32)
    assert half.fx == pytest.approx(whole.fx / 2) and half.cy == pytest.approx(whole.cy / 2)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
@pytest.mark.parametrize("pictures", ["images", "input", "rgb", "."])
def test_where_model_and_pictures_may_lie(tmp_path: Path, place: str, pictures: str) -> None:
    write_text(tmp_path / place)
    write_pictures(tmp_path / pictures)
    assert len(read_scene(tmp_path).views) == COUNT


def test_a_folder_that_says_more_is_of_another_layout(folder: Path) -> None:
    write_json(folder / "transforms.json", {"frames": []})
    with pytest.raises(DataError, match=r"transforms\.json: no train frames"):
        read_scene(folder)
    (folder / "transforms.json").unlink()
    np.save(folder / "poses_bounds.npy", np.zeros((2, 17)))
    assert read_scene(folder).layout == "colmap"  # LLFF's pictures
    (folder / "cam00" / "images").mkdir(parents=True)
    with pytest.raises(DataError, match="has 2 poses, but there are 1 cameras"):
        read_scene(folder)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["a/0010.png", "a/0020.png", "b/0010.png", "b/0050.png"], [0, 0.25, 0, 1]),
        (["cam1_3.jpg", "cam1_5.jpg", "cam2_4.jpg"], [0, 1, 0.5]),
        (["left.png", "middle.png", "right.png"], [0, 0.5, 1]),
        (["a1.png", "b1.png", "c1.png"], [0, 0.5, 1]),
        (["one.png"], [0]),
    ],
)
def test_times_are_the_last_numbers_of_names_or_their_order(
    names: list[str], times: list[float]
) -> None:
    assert times_by_name(names) == times


def replace(name: str, old: bytes, new: bytes) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        path = folder / "sparse" / "0" / name
        content = path.read_bytes()
        assert old in content
        path.write_bytes(content.replace(old, new, 1))

    return spoil


def cut(name: str, length: int) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        path = folder / "sparse" / "0" / name
        path.write_bytes(path.read_bytes()[:length])

    return spoil


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no images file": (lambda f: (f / "sparse/0/images.bin").unlink(), r"images\.bin cannot be"),
    "no points file": (lambda f: (f / "sparse/0/points3D.bin").unlink(), r"points3D\.bin cannot"),
    "empty cameras": (cut("cameras.bin", 0), r"cameras\.bin: is damaged"),
    "half a camera": (cut("cameras.bin", 60), r"cameras\.bin: is damaged"),
    "half the images": (cut("images.bin", 300), r"images\.bin: is damaged"),
    "the last observation cut": (cut("images.bin", -3), r"images\.bin: is damaged"),
    "half the points": (cut("points3D.bin", 300), r"points3D\.bin: is damaged"),
    "the last track cut": (cut("points3D.bin", -3), r"points3D\.bin: is damaged"),
    "no images": (lambda f: (f / "sparse/0/images.bin").write_bytes(bytes(8)), "no registered"),
    "a model unknown": (replace("cameras.bin", struct.pack("<ii", 7, 4), struct.pack("<ii", 7, 7)),
                        "camera model number 7; known are SIMPLE_PINHOLE"),
    "focal length 0": (replace("cameras.bin", struct.pack("<d", 50), bytes(8)), "is damaged"),
    "a camera gone": (replace("cameras.bin", struct.pack("<ii", 7, 4), struct.pack("<ii", 8, 4)),
                      r"'f000\.png': camera 7 is not in"),
    "a pose that is NaN": (replace("images.bin", struct.pack("<d", 0.1), b"\xff" * 8), "damaged"),
    "another shape": (replace("cameras.bin", struct.pack("<QQ", 40, 64),
                              struct.pack("<QQ", 64, 40)), "its camera's size is 64 x 40"),
    "a picture gone": (lambda f: (f / "images/f004.png").unlink(), r"f004\.png does not exist"),
    "no pictures": (lambda f: (f / "images").rename(f / "photos"), "is in none of images, input"),
    "a picture outside": (replace("images.bin", b"f003.png", b"../a.png"), "leads out of"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(
    folder: Path, spoil: Callable[[Path], Any], message: str
) -> None:
    write_picture(folder / "a.png", noise(64, 40, 3))
    spoil(folder)
    assert_refused(folder, message)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cameras.txt", "7 OPENCV 40 64 1 2 3\n"),
        ("cameras.txt", "7 OPENCV\n"),
        ("images.txt", "1 a b c d e f g 7 f000.png\n\n"),
        ("images.txt", "1 0 0 0 0 0 0 0 7 f000.png\n\n"),
        ("points3D.txt", "1 2 3\n"),
    ],
)
def test_bad_text_is_refused_in_one_line(tmp_path: Path, name: str, text: str) -> None:
    write_text(tmp_path / "sparse")
    write_pictures(tmp_path / "images")
    (tmp_path / "sparse" / name).write_text(text)
    with pytest.raises(DataError, match="is damaged") as error:
        read_scene(tmp_path)
    assert "\n" not in str(error.value) and name in str(error.value)
