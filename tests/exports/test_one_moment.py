"""Files of one moment, read back by readers written here from the layouts, and by somebody else's.

gsply and PlayCanvas' splat-transform are packages on registries that read some of them; without
them those tests are skipped.
"""

from __future__ import annotations

import gzip
import json
import re
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from export_checks import Array, angles, sigmoid, unit, usual_splats, write
from node_packages import node, package

from gsdmsr_cli.exports._ply import read_ply
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.scene.native import cv2

SH_C0 = 0.28209479177387814


@dataclass(frozen=True)
class Read:
    """What a file says: opacities 0 to 1, natural logarithms of scales, constants of harmonics."""

    means: Array
    quats: Array
    log_scales: Array
    opacities: Array
    constants: Array
    harmonics: Array


def read_splat(path: Path) -> Read:
    kinds = [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
    rows = np.frombuffer(path.read_bytes(), kinds)
    return Read(
        rows["means"],
        (rows["quats"].astype(float) - 128) / 128,
        np.log(rows["scales"].astype(float)),
        rows["rgba"][:, 3] / 255,
        (rows["rgba"][:, :3] / 255 - 0.5) / SH_C0,
        np.zeros((len(rows), 0, 3)),
    )


def bits(packed: Array, *widths: int) -> Array:
    """Return fields of numbers, the highest first, each as a share of what it can hold."""
    fields, shift = [], sum(widths)
    for width in widths:
        shift -= width
        fields.append(((packed >> shift) & (2**width - 1)) / (2**width - 1))
    return np.stack(fields, axis=1)


def with_largest(places: Array, others: Array) -> Array:
    """Return quaternions whose component at a place is what the others leave of unit length."""
    rows = []
    for place, other in zip(places, others, strict=True):
        rows.append(np.insert(other, place, np.sqrt(max(0.0, 1 - float((other**2).sum())))))
    return np.reshape(rows, (len(places), 4))


def read_compressed_ply(path: Path) -> Read:
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    counts = {words[1]: int(words[2]) for words in map(str.split, lines) if words[0] == "element"}
    properties = [line.split()[2] for line in lines if line.startswith("property")]
    limits = [f"{m}_{a}" for t in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), "rgb")
              for m in ("min", "max") for a in t]  # fmt: skip
    packed = [f"packed_{name}" for name in ("position", "rotation", "scale", "color")]
    rest = len(properties) - 22
    assert properties == limits + packed + [f"f_rest_{i}" for i in range(rest)]
    count = counts["vertex"]
    assert counts.get("sh", 0) == (count if rest else 0) and counts["chunk"] == -(-count // 256)
    chunks = np.frombuffer(body, "<f4", counts["chunk"] * 18).reshape(-1, 3, 2, 3).astype(float)
    rows = np.frombuffer(body, "<u4", count * 4, chunks.size * 4).reshape(-1, 4).astype(np.int64)
    last = np.frombuffer(body, "u1", offset=chunks.size * 4 + count * 16)
    last = last.reshape(count, 3, rest // 3)
    own = np.repeat(chunks, 256, axis=0)[:count]

    def between(group: int, shares: Array) -> Array:
        return np.asarray(own[:, group, 0] + shares * (own[:, group, 1] - own[:, group, 0]))

    colours = bits(rows[:, 3], 8, 8, 8, 8)
    turns = (bits(rows[:, 1] & (2**30 - 1), 10, 10, 10) - 0.5) * np.sqrt(2)
    return Read(
        between(0, bits(rows[:, 0], 11, 10, 11)),
        with_largest(rows[:, 1] >> 30, turns),
        between(1, bits(rows[:, 2], 11, 10, 11)),
        colours[:, 3],
        (between(2, colours[:, :3]) - 0.5) / SH_C0,
        ((last.transpose(0, 2, 1) + 0.5) / 256 - 0.5) * 8,
    )


def read_spz(path: Path) -> Read:
    content = gzip.decompress(path.read_bytes())
    magic, version, count, degree, fraction, flags, reserved = struct.unpack(
        "<4sIIBBBB", content[:16]
    )
    assert (magic, version, flags, reserved) == (b"NGSP", 3, 0, 0)
    rest = (degree + 1) ** 2 - 1
    widths, start, parts = (9, 1, 3, 3, 4, 3 * rest), 16, []
    for width in widths:
        part = np.frombuffer(content, "u1", width * count, start).reshape(count, width)
        parts.append(part.astype(np.int64))
        start += width * count
    assert start == len(content)
    thirds = parts[0].reshape(count, 3, 3)
    steps = thirds[..., 0] | thirds[..., 1] << 8 | thirds[..., 2] << 16
    steps = np.where(steps >= 2**23, steps - 2**24, steps)
    turn = parts[4][:, 0] | parts[4][:, 1] << 8 | parts[4][:, 2] << 16 | parts[4][:, 3] << 24
    fields = np.stack([(turn >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    others = np.where(fields & 512, -1, 1) * (fields & 511) / 511 * np.sqrt(0.5)
    return Read(
        steps / 2**fraction,
        with_largest(turn >> 30, others)[:, [3, 0, 1, 2]],
        parts[3] / 16 - 10,
        parts[1][:, 0] / 255,
        (parts[2] / 255 - 0.5) / 0.15,
        (parts[5].reshape(count, rest, 3) - 128) / 128,
    )


def read_glb(path: Path) -> Read:
    content = path.read_bytes()
    magic, version, length, text, kind = struct.unpack("<4sIII4s", content[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    document = json.loads(content[20 : 20 + text])
    if not document["scenes"][0].get("nodes"):
        return Read(*(np.zeros((0, n)) for n in (3, 4, 3)), *np.zeros((1, 0)), np.zeros((0, 3)),
                    np.zeros((0, 0, 3)))  # fmt: skip
    size, kind = struct.unpack("<I4s", content[20 + text : 28 + text])
    buffer = content[28 + text :]
    assert (len(buffer), kind, size % 4) == (size, b"BIN\0", 0)
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0 and document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse"
    tables = {}
    for name, place in primitive["attributes"].items():
        accessor = document["accessors"][place]
        view, columns = document["bufferViews"][accessor["bufferView"]], {"SCALAR": 1, "VEC3": 3}
        shape = accessor["count"], columns.get(accessor["type"], 4)
        values = np.frombuffer(buffer, "<f4", shape[0] * shape[1], view["byteOffset"])
        tables[name.removeprefix("KHR_gaussian_splatting:")] = values.reshape(shape)
        if name == "POSITION":
            assert accessor["min"] == values.reshape(shape).min(axis=0).tolist()
            assert accessor["max"] == values.reshape(shape).max(axis=0).tolist()
    names = [f"SH_DEGREE_{d}_COEF_{i}" for d in range(4) for i in range(2 * d + 1)]
    harmonics = [tables.pop(name) for name in names if name in tables]
    assert set(tables) == {"POSITION", "ROTATION", "SCALE", "OPACITY"}
    return Read(
        tables["POSITION"], tables["ROTATION"][:, [3, 0, 1, 2]],
        np.log(tables["SCALE"].astype(float)), tables["OPACITY"][:, 0], harmonics[0],
        np.stack(harmonics[1:], axis=1) if harmonics[1:] else np.zeros((shape[0], 0, 3)),
    )  # fmt: skip


def pixels(content: bytes) -> Array:
    """Return the RGBA pixels of a lossless WebP picture from the first row on, (H, W, 4) int64."""
    assert content[:4] + content[8:16] == b"RIFFWEBPVP8L"
    picture = cv2.imdecode(np.frombuffer(content, "u1"), cv2.IMREAD_UNCHANGED)
    opaque = np.full((*picture.shape[:2], 1), 255)
    return np.concatenate([picture[..., 2::-1], picture[..., 3:], opaque], axis=2)[..., :4]


def read_sog(path: Path) -> Read:
    archive = zipfile.ZipFile(path)
    meta = json.loads(archive.read("meta.json"))
    assert meta["version"] == 2 and archive.testzip() is None
    count = meta["count"]

    def table(part: str, place: int = 0) -> Array:
        picture = pixels(archive.read(meta[part]["files"][place]))
        assert picture.shape[0] * picture.shape[1] >= count
        return picture.reshape(-1, 4)[:count]

    low, high = (np.array(meta["means"][name]) for name in ("mins", "maxs"))
    logs = low + (table("means") + 256 * table("means", 1))[:, :3] / 65535 * (high - low)
    turn, colours = table("quats"), table("sh0")
    assert not count or (turn[:, 3].min() >= 252 and colours[:, 3].min() > 0)
    constants = np.array(meta["sh0"]["codebook"])[colours[:, :3]]
    harmonics = np.zeros((count, 0, 3))
    if "shN" in meta:
        bands, width = meta["shN"]["bands"], (meta["shN"]["bands"] + 1) ** 2 - 1
        known = pixels(archive.read(meta["shN"]["files"][0]))
        assert known.shape[1] == 64 * width and bands in (1, 2, 3)
        labels = table("shN", 1)[:, 0] + 256 * table("shN", 1)[:, 1]
        assert labels.max() < meta["shN"]["count"]
        rows = np.array(meta["shN"]["codebook"])[known[..., :3]].reshape(-1, width, 3)
        harmonics = rows[labels]
    return Read(
        np.sign(logs) * np.expm1(np.abs(logs)),
        with_largest(turn[:, 3] - 252, (turn[:, :3] / 255 - 0.5) * np.sqrt(2)),
        np.array(meta["scales"]["codebook"])[table("scales")[:, :3]],
        colours[:, 3] / 255,
        constants,
        harmonics,
    )


@dataclass(frozen=True)
class Form:
    """A format: its suffix, a reader, and how far from the truth each part may be."""

    suffix: str
    read: Callable[[Path], Read]
    means: float
    angle: float
    log_scales: float
    opacities: float
    constants: float
    harmonics: float


BYTE = 0.5 / 255
FORMS = {
    "splat": Form(".splat", read_splat, 0, 0.014, 1e-6, BYTE, BYTE / SH_C0, 0),
    "compressed-ply": Form(
        ".compressed.ply", read_compressed_ply, 0.006, 0.004, 0.005, BYTE, 0.03, 4 / 256
    ),
    "spz": Form(".spz", read_spz, 0.5 / 4096, 0.006, 0.5 / 16, BYTE, BYTE / 0.15, 0.5 / 128),
    "sog": Form(".sog", read_sog, 3e-4, 0.015, 0.04, BYTE, 0.04, 0.01),
    "gltf": Form(".glb", read_glb, 0, 1e-6, 1e-6, 1e-6, 0, 0),
}
SLACK = 1e-6


def as_they_were(splats: Splats, found: Read) -> tuple[Splats, Read]:
    """Return both in the order of the means, since compressed PLY has an order of its own."""
    nearest = np.linalg.norm(found.means[:, None] - splats.means.numpy(), axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(len(splats)))
    return splats.take(torch.from_numpy(nearest)), found


def assert_holds(form: Form, splats: Splats, found: Read) -> None:
    """The splats, as the same axes have them, are what was read but for the format's rounding."""
    assert len(found.means) == len(splats)
    if not len(splats):
        return
    splats, found = as_they_were(splats, found)
    constants, rest = splats.sh[:, 0].numpy(), splats.sh[:, 1:].numpy()
    for name, value, expected, off in (
        ("means", found.means, splats.means.numpy(), form.means),
        ("log_scales", found.log_scales, splats.log_scales.numpy(), form.log_scales),
        ("opacities", found.opacities, sigmoid(splats.logit_opacities), form.opacities),
        ("constants", found.constants, constants, form.constants),
        ("harmonics", found.harmonics, rest, form.harmonics),
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-6, atol=off + SLACK, err_msg=name)
    assert angles(found.quats, unit(splats.quats)).max() <= form.angle


def splats_for(format_: str, count: int, degree: int) -> Splats:
    splats = usual_splats(count, degree)
    if format_ == "splat":  # colours from black to white alone
        splats.sh[:, 0].clamp_(-0.5 / SH_C0, 0.5 / SH_C0)
    return splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 300])
@pytest.mark.parametrize("format_", FORMS)
def test_what_is_written_is_read_back(
    tmp_path: Path, format_: str, count: int, degree: int
) -> None:
    form, splats = FORMS[format_], splats_for(format_, count, degree)
    kept = {"sh_degree": 0} if format_ == "splat" else {}
    out = tmp_path / "made" / f"a{form.suffix}"
    result = write(format_, splats, out, axes="scene", **kept)
    assert (result.files, result.splats, result.lost) == ([out], count, [])
    expected = splats if not kept else Splats(**splats.tensors() | {"sh": splats.sh[:, :1]})
    assert_holds(form, expected, form.read(out))


@pytest.mark.parametrize("format_", FORMS)
def test_a_time_and_axes_are_those_that_were_asked_for(tmp_path: Path, format_: str) -> None:
    form, splats = FORMS[format_], splats_for(format_, 20, 0)
    for axes in ({}, {"axes": "y-up"}):
        (path,) = write(format_, splats, tmp_path / f"a{form.suffix}", time=0.5, **axes).files
        x, y, z = (splats.means + torch.tensor([0.0, 0.5, 0.0])).unbind(1)
        upright = axes or format_ in ("spz", "gltf")
        expected = torch.stack([x, z, -y] if upright else [x, y, z], dim=1).numpy()
        distances = np.linalg.norm(form.read(path).means[:, None] - expected, axis=2)
        assert distances.min(axis=1).max() <= 2 * form.means + SLACK


@pytest.mark.parametrize("format_", FORMS)
def test_values_that_are_not_finite_and_other_names_are_refused(
    tmp_path: Path, format_: str
) -> None:
    form = FORMS[format_]
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        splats = usual_splats(5, 0)
        getattr(splats, name)[1] = float("nan")
        with pytest.raises(DataError, match="1 of 5 splats hold NaN"):
            write(format_, splats, tmp_path / f"a{form.suffix}")
    with pytest.raises(UsageError, match=f"--format {format_} writes one file, but"):
        write(format_, usual_splats(5, 0), tmp_path / "a.obj")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("format_", "name", "value", "told"),
    [
        ("splat", "log_scales", 90.0, "log_scales of 1 splats, outside -87 to 88"),
        ("gltf", "log_scales", -90.0, "log_scales of 1 splats, outside -87 to 88"),
        ("compressed-ply", "log_scales", -21.0, "log_scales of 1 splats, outside -20 to 20"),
        ("compressed-ply", "sh", 5.0, "harmonics of 1 splats, outside -4 to 4"),
        ("spz", "means", 3000.0, "means of 1 splats, outside -2048 to 2048"),
        ("spz", "log_scales", -11.0, "log_scales of 1 splats, outside -10 to 5.9375"),
        ("spz", "sh", 1.5, "harmonics of 1 splats, outside -1 to 1"),
        ("spz", "sh", 9.0, "constants of 1 splats, outside -3.33333 to 3.33333"),
    ],
)
def test_values_that_a_format_has_no_numbers_for_are_refused_unless_lossy(
    tmp_path: Path, format_: str, name: str, value: float, told: str
) -> None:
    splats = usual_splats(5, 0 if format_ == "splat" else 1)
    getattr(splats, name)[2] = value
    out = tmp_path / f"a{FORMS[format_].suffix}"
    with pytest.raises(UsageError, match=re.escape(told)):
        write(format_, splats, out, axes="scene")
    result = write(format_, splats, out, axes="scene", lossy=True)
    assert told in result.lost
    assert len(FORMS[format_].read(out).means) == 5


def test_a_splat_has_one_colour(tmp_path: Path) -> None:
    splats, out = splats_for("splat", 5, 2), tmp_path / "a.splat"
    with pytest.raises(UsageError, match="cannot carry colours that depend on the view"):
        write("splat", splats, out)
    assert write("splat", splats, out, lossy=True).lost
    once = out.read_bytes()
    assert not write("splat", splats, out, sh_degree=0).lost and out.read_bytes() == once


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("format_", ["compressed-ply", "spz", "ply"])
def test_somebody_else_reads_the_same(tmp_path: Path, format_: str, degree: int) -> None:
    gsply = pytest.importorskip("gsply", reason="no gsply: pip install gsply")
    form, splats = FORMS.get(format_, FORMS["gltf"]), usual_splats(300, degree)
    out = tmp_path / f"a{'.ply' if format_ == 'ply' else form.suffix}"
    write(format_, splats, out, axes="scene")
    data = gsply.read_spz(str(out)) if format_ == "spz" else gsply.plyread(str(out))
    data = data.to_ply_format() if hasattr(data, "to_ply_format") else data
    rest = np.asarray(data.shN) if degree else np.zeros((300, 0, 3))
    opacities = sigmoid(torch.from_numpy(np.array(data.opacities).reshape(-1)))
    constants = np.asarray(data.sh0).reshape(-1, 3)
    read = Read(data.means, np.asarray(data.quats), data.scales, opacities, constants, rest)
    assert_holds(form, splats, read)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("format_", ["sog", "compressed-ply", "ply"])
def test_splat_transform_reads_the_same(tmp_path: Path, format_: str, degree: int) -> None:
    program = package("@playcanvas/splat-transform") / "bin" / "cli.mjs"
    form = FORMS.get(format_, FORMS["gltf"])
    splats = usual_splats(300, degree)
    out = tmp_path / f"a{'.ply' if format_ == 'ply' else form.suffix}"
    write(format_, splats, out, axes="scene")
    node(program, out, tmp_path / "theirs.ply")
    theirs = read_ply(tmp_path / "theirs.ply")
    read = Read(
        theirs.means.numpy(), theirs.quats.numpy(), theirs.log_scales.numpy(),
        sigmoid(theirs.logit_opacities), theirs.sh[:, 0].numpy(), theirs.sh[:, 1:].numpy(),
    )  # fmt: skip
    assert_holds(form, splats, read)
