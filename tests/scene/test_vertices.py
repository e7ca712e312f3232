"""PLY files in each encoding, and what is not one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.vertices import read_vertices

FIELDS = [("x", "f4"), ("red", "u1"), ("y", "f8"), ("label", "i2")]
NAMES = {"f4": "float", "u1": "uchar", "f8": "double", "i2": "short"}


def table() -> np.ndarray:
    rng = np.random.default_rng(0)
    rows = np.empty(5, np.dtype(FIELDS))
    for name, kind in FIELDS:
        rows[name] = (rng.random(5) * 200 - (0 if kind == "u1" else 100)).astype(kind)
    return rows


def write(path: Path, encoding: str, after: bytes = b"") -> np.ndarray:
    rows = table()
    lines = ["ply", f"format {encoding} 1.0", "comment made by a test", "element vertex 5"]
    lines += [f"property {NAMES[kind]} {name}" for name, kind in FIELDS]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header", ""]
    if encoding == "ascii":
        values = (" ".join(repr(v.item()) for v in row) for row in rows)
        payload = "\n".join(values).encode()
    else:
        order = "<" if "little" in encoding else ">"
        payload = rows.astype(np.dtype([(n, order + k) for n, k in FIELDS])).tobytes()
    path.write_bytes("\n".join(lines).encode() + payload + after)
    return rows


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("after", [b"", b"\n3 0 1 2\n"])
def test_every_encoding_is_read(tmp_path: Path, encoding: str, after: bytes) -> None:
    rows = write(tmp_path / "a.ply", encoding, after)
    found = read_vertices(tmp_path / "a.ply")
    assert found.dtype.names == rows.dtype.names
    for name in rows.dtype.names or ():
        assert (found[name] == rows[name]).all()


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_file_that_is_cut_short_is_refused(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.ply"
    write(path, encoding)
    whole = path.read_bytes()
    path.write_bytes(whole[: -len(whole.split(b"end_header\n")[1]) // 2])
    with pytest.raises(DataError, match="cut short"):
        read_vertices(path)


def test_other_encodings_and_faces_alone_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write(path, "binary_little_endian")
    whole = path.read_bytes()
    for old, new in ((b"binary_little", b"binary_middle"), (b"element vertex", b"element edge")):
        path.write_bytes(whole.replace(old, new))
        with pytest.raises(DataError, match="is not a PLY file that starts with vertices"):
            read_vertices(path)
