"""Files that are damaged or made to do harm are refused with a sentence that names them."""

from __future__ import annotations

import io
import json
import struct
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import noise, pose, write_colmap, write_dnerf, write_json, write_picture
from refusals import assert_refused

from gsdmsr_cli.formats import _points, read_scene
from gsdmsr_cli.formats._arrays import read_npy, read_npz
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json


def sentence(read: Callable[[], object], path: Path) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # they would be further lines on stderr
        with pytest.raises(DataError) as error:
            read()
    assert str(path) in str(error.value) and str(error.value).isprintable()
    return str(error.value)


def npy(header: str, content: bytes = b"") -> bytes:
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + content


def npz(content: bytes, **details: Any) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", **details) as archive:
        archive.writestr("data.npy", content)
    return file.getvalue()


WHOLE = npy("{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3)}", bytes(48))
DEFLATED = npz(WHOLE, compression=zipfile.ZIP_DEFLATED)
CORRUPT = DEFLATED.replace(b"data.npy", b"data.npy", 1)[:40] + b"\xff" * 20 + DEFLATED[60:]

NPY = {
    "empty": b"",
    "an npz": npz(WHOLE),
    "cut in the header": WHOLE[:40],
    "cut in the numbers": WHOLE[:-1],
    "huge": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 3)}"),
    "negative": npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 3)}", bytes(48)),
    "objects": npy("{'descr': '|O', 'fortran_order': False, 'shape': (1, 3)}", b"cos\nsystem\n."),
    "text": npy("{'descr': '<U3', 'fortran_order': False, 'shape': (2, 3)}", bytes(72)),
    "fields": npy("{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (2, 3)}", bytes(48)),
    "no header": npy("os.system('true')"),
    "deep header": npy("(" * 90 + ")" * 20),
    "a number as shape": npy("{'descr': '<f8', 'fortran_order': False, 'shape': 6}", bytes(48)),
    "a type that is none": npy("{'descr': 'f8,', 'fortran_order': False, 'shape': (6,)}"),
}


@pytest.mark.parametrize("content", NPY.values(), ids=NPY)
def test_a_damaged_npy_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "points.npy"
    path.write_bytes(content)
    sentence(lambda: read_npy(path), path)


NPZ = {
    "empty": b"",
    "an npy": WHOLE,
    "cut": npz(WHOLE)[:-30],
    "corrupt deflate": CORRUPT,
    "other name": npz(WHOLE).replace(b"data.npy", b"info.npy"),
    "huge": npz(npy("{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 3)}")),
    "objects": npz(npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", b"cos\n")),
    "other packing": npz(WHOLE, compression=zipfile.ZIP_LZMA),
    "no magic": npz(b"x" * 100),
}


@pytest.mark.parametrize("content", NPZ.values(), ids=NPZ)
def test_a_damaged_npz_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "init_pt_cld.npz"
    path.write_bytes(content)
    sentence(lambda: read_npz(path, "data"), path)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("dtype", ["<f8", ">f4", "<i2", "|u1", "<f2"])
def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path, order: Any, dtype: str) -> None:
    table = np.arange(12).reshape(4, 3).astype(dtype, order=order)
    np.save(tmp_path / "a.npy", table)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy"), table)
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", data=table)
        np.testing.assert_array_equal(read_npz(tmp_path / "a.npz", "data"), table)


def ply(count: str, rows: str, kind: str = "uchar", encoding: str = "ascii") -> bytes:
    names = "".join(f"property float {axis}\n" for axis in "xyz")
    names += "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
    return f"ply\nformat {encoding} 1.0\nelement vertex {count}\n{names}end_header\n{rows}".encode()


PLY = {
    "a count of 20 digits": ply("9" * 20, "1 2 3 4 5 6\n"),
    "a count of 900 digits": ply("9" * 900, "1 2 3 4 5 6\n"),
    "a binary count of 20 digits": ply("9" * 20, "123", encoding="binary_little_endian"),
    "NaN as uchar": ply("1", "1 2 3 nan 5 6\n"),
    "infinity as uchar": ply("1", "1 2 3 inf 5 6\n"),
    "beyond uchar": ply("1", "1 2 3 256 5 6\n"),
    "below uchar": ply("1", "1 2 3 -1 5 6\n"),
    "words": ply("1", "1 2 3 a 5 6\n"),
}


@pytest.mark.parametrize("content", PLY.values(), ids=PLY)
def test_a_damaged_ply_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(content)
    sentence(lambda: _points.read_ply(path), path)


def test_colours_that_are_no_numbers_do_not_reach_the_splats(tmp_path: Path) -> None:
    path = tmp_path / "points.ply"
    path.write_bytes(ply("3", "1 2 3 nan .5 .6\n1 2 3 .4 .5 7\n1 2 3 .4 .5 -.1\n", "float"))
    points, colours = _points.read_ply(path)
    assert len(points) == 2 and colours is not None
    np.testing.assert_allclose(colours, [[0.4, 0.5, 1], [0.4, 0.5, 0]])


DEEP = "[" * 100_000
HOSTILE_JSON = {
    "deep": '{"frames": ' + DEEP,
    "deep but whole": '{"frames": ' + "[" * 900 + "]" * 900 + "}",
    "deep names": '{"frames": [{"file_path": ' + "[" * 900 + "]" * 900 + ', "time": 0, '
    '"transform_matrix": 1}]}',
    "a number of 5000 digits": '{"camera_angle_x": ' + "9" * 5000 + ', "frames": [{}]}',
    "control characters": '{"frames": [{"file_path": "\\u001b[31m\\u202ea\\n", "time": 0, '
    '"transform_matrix": 1}]}',
}


@pytest.mark.parametrize("text", HOSTILE_JSON.values(), ids=HOSTILE_JSON)
@pytest.mark.parametrize("name", ["transforms_train.json", "transforms.json"])
def test_hostile_json_is_refused(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    sentence(lambda: read_scene(tmp_path), tmp_path)


def test_json_that_is_nested_too_deeply_is_refused_everywhere(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(DEEP)
    sentence(lambda: read_json(tmp_path / "run.json"), tmp_path)


def test_a_size_that_no_picture_has_is_refused(tmp_path: Path) -> None:
    folder = write_dnerf(tmp_path / "scene")
    path = folder / "transforms_train.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps(document | {"w": 1e300, "h": 8e299}))
    assert_refused(folder, "w is 1e\\+300; it must be a whole number of pixels, 1 to 1000000")


PINHOLE = "1 PINHOLE 10 8 9 9 5 4"
COLMAP = {
    "fy of 0": ("1 PINHOLE 10 8 9 0 5 4", "001.png", "the parameters"),
    "a negative fy": ("1 PINHOLE 10 8 9 -9 5 4", "001.png", "the parameters"),
    "a size of 400 digits": (f"1 PINHOLE {10**400} 8 9 9 5 4", "001.png", "a camera of 1000"),
    "an absolute name": (PINHOLE, "/etc/passwd", "must be relative"),
    "a name that leads out": (PINHOLE, "../../../etc/passwd", "leads out of"),
}


@pytest.mark.parametrize(("camera", "name", "message"), COLMAP.values(), ids=COLMAP)
def test_hostile_colmap_models_are_refused(
    tmp_path: Path, camera: str, name: str, message: str
) -> None:
    assert_refused(write_colmap(tmp_path / "scene", [name], camera), message)


def test_a_name_in_a_colmap_model_that_is_not_utf8_is_refused_by_name(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "scene", ["a.png"])
    for name in ("cameras", "images", "points3D"):
        (folder / f"sparse/0/{name}.txt").unlink()
        (folder / f"sparse/0/{name}.bin").write_bytes(struct.pack("<Q", 0))
    image = struct.pack("<Qi7di", 1, 1, 1, 0, 0, 0, 0, 0, 4, 1) + b"\xff.png\0" + bytes(8)
    (folder / "sparse/0/images.bin").write_bytes(image)
    assert r"b'\xff.png', which is not UTF-8" in sentence(lambda: read_scene(folder), folder)


def test_names_with_thousands_of_digits_are_no_times(tmp_path: Path) -> None:
    from gsdmsr_cli.formats.colmap import times_by_name

    assert times_by_name([f"{'9' * 5000}{i}.png" for i in (1, 2, 3)]) == [0, 0.5, 1]
    assert times_by_name(["1700000000000000000.png", "1700000000000000004.png"]) == [0, 1]


def nerfies(folder: Path, name: str) -> Path:
    write_json(folder / "dataset.json", {"ids": [name], "train_ids": [name], "val_ids": []})
    write_json(folder / "metadata.json", {name: {"time_id": 0}})
    (folder / "camera").mkdir()
    write_picture(folder / "rgb" / "2x" / "1.png", noise(8, 10, 3))
    return folder


@pytest.mark.parametrize("name", ["../../outside", "/etc/hosts", "a\0b", "9" * 5000])
def test_ids_of_nerfies_name_cameras_inside_the_folder(tmp_path: Path, name: str) -> None:
    write_json(tmp_path / "outside.json", {"focal_length": "read from outside"})
    folder = nerfies(tmp_path / "scene", name)
    told = sentence(lambda: read_scene(folder), folder)
    assert "read from outside" not in told


@pytest.mark.parametrize("layout", ["colmap", "dnerf"])
def test_pictures_that_links_take_out_of_the_folder_are_refused(
    tmp_path: Path, layout: str
) -> None:
    if layout == "dnerf":
        folder, name = write_dnerf(tmp_path / "scene"), "train"
    else:
        folder, name = write_colmap(tmp_path / "scene", ["001.png"]), "images"
    read_scene(folder)
    (folder / name).rename(tmp_path / "elsewhere")
    (folder / name).symlink_to(tmp_path / "elsewhere")
    assert_refused(folder, f"leads out of {folder}; put the file inside")


def test_names_of_views_do_not_steer_a_terminal(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    name = "a\x1b[31m\u202eb"
    write_picture(folder / "images" / "plain.png", noise(8, 10, 3))
    (folder / "images" / "plain.png").rename(folder / "images" / f"{name}.png")
    frame = {"file_path": f"images/{name}.png", "time": 0, "transform_matrix": pose()}
    write_json(folder / "transforms.json", {"camera_angle_x": 0.7, "frames": [frame]})
    assert read_scene(folder).views[0].name == r"a\x1b[31m\u202eb"


def test_a_list_in_place_of_a_name_is_refused(tmp_path: Path) -> None:
    """Found by fuzzing: it is among the names, and cannot be looked up."""
    frame = {"file_path": ["a.png"], "transform_matrix": pose()}
    document = {"camera_angle_x": 0.7, "frames": [frame], "train_filenames": [["a.png"]]}
    write_json(tmp_path / "transforms.json", document)
    assert_refused(tmp_path, "it must name a file")


def test_a_frame_that_names_its_picture_by_an_object_is_told(tmp_path: Path) -> None:
    frame = {"file_path": {"a": 1}, "transform_matrix": pose()}
    write_json(tmp_path / "transforms.json", {"frames": [frame], "train_filenames": ["a.png"]})
    assert_refused(tmp_path, "it must name a file")
