"""PLY export: bytes by an independent parse, round trips, sequences and refusals."""

from __future__ import annotations

import errno
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from export_checks import FACTS, Falling
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from motion_checks import model_of, splats_at
from torch import Tensor

from gsdmsr_cli.exports import export
from gsdmsr_cli.exports._ply import read_ply, write_ply
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.strict import Located


def make_splats(n: int, degree: int, seed: int = 0) -> Splats:
    """Return random splats whose quaternions are not normalised."""
    generator = torch.Generator().manual_seed(seed)
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": ()}
    shapes["sh"] = ((degree + 1) ** 2, 3)
    return Splats(**{k: 3 * torch.randn((n, *s), generator=generator) for k, s in shapes.items()})


def falling(splats: Splats, **beside: Tensor) -> Model:
    return model_of(splats, Falling(**beside))


def parse(path: Path) -> tuple[list[str], np.ndarray]:
    """Return header lines and the table of float32, knowing only what a PLY is."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    columns = sum(line.startswith("property float ") for line in lines)
    return lines, np.frombuffer(body, "<f4").reshape(-1, columns)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_header_and_columns_are_those_of_3dgs(tmp_path: Path, degree: int) -> None:
    splats = make_splats(7, degree)
    write_ply(tmp_path / "a.ply", splats)
    lines, table = parse(tmp_path / "a.ply")
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert lines[3:] == [f"property float {name}" for name in names]
    column = {name: table[:, i] for i, name in enumerate(names)}
    for axis, letter in enumerate("xyz"):
        assert np.array_equal(column[letter], splats.means[:, axis].numpy())
        assert not column[f"n{letter}"].any()
        assert np.array_equal(column[f"scale_{axis}"], splats.log_scales[:, axis].numpy())
    for channel in range(3):
        assert np.array_equal(column[f"f_dc_{channel}"], splats.sh[:, 0, channel].numpy())
        for k in range(1, (degree + 1) ** 2):
            stored = column[f"f_rest_{channel * (rest // 3) + k - 1}"]
            assert np.array_equal(stored, splats.sh[:, k, channel].numpy())
    assert np.array_equal(column["opacity"], splats.logit_opacities.numpy())
    quats = np.stack([column[f"rot_{i}"] for i in range(4)], axis=1)
    expected = splats.quats.numpy() / np.linalg.norm(splats.quats.numpy(), axis=1, keepdims=True)
    np.testing.assert_allclose(quats, expected, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(n=st.integers(0, 40), degree=st.integers(0, 3), seed=st.integers(0, 2**31))
@example(n=0, degree=0, seed=0)
@example(n=0, degree=3, seed=0)
def test_round_trip_is_exact(tmp_path: Path, n: int, degree: int, seed: int) -> None:
    splats = make_splats(n, degree, seed)
    write_ply(tmp_path / "a.ply", splats)
    back = read_ply(tmp_path / "a.ply")
    assert (len(back), back.sh_degree) == (n, degree)
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(getattr(back, name), getattr(splats, name)), name
    unit = torch.nn.functional.normalize(splats.quats.double(), dim=1).float()
    assert torch.equal(back.quats, unit)
    assert all(tensor.dtype == torch.float32 for tensor in back.tensors().values())


def test_zero_quaternion_is_written_as_the_identity(tmp_path: Path) -> None:
    splats = make_splats(3, 0)
    splats.quats[1] = 0.0
    write_ply(tmp_path / "a.ply", splats)
    assert read_ply(tmp_path / "a.ply").quats[1].tolist() == [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("name", "poison"),
    [
        (name, poison)
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh")
        for poison in (float("nan"), float("inf"), 1e39)
        if (name, poison) != ("quats", 1e39)  # a huge quaternion has a direction all the same
    ],
)
def test_broken_rows_are_counted_and_nothing_is_written(
    tmp_path: Path, name: str, poison: float
) -> None:
    splats = make_splats(9, 1).map(torch.Tensor.double)  # 1e39 overflows only as float32
    getattr(splats, name)[[2, 5]] = poison
    with pytest.raises(DataError, match="2 of 9 splats"):
        write_ply(tmp_path / "a.ply", splats)
    assert list(tmp_path.iterdir()) == []


def test_splats_that_require_gradients_are_written(tmp_path: Path) -> None:
    splats = make_splats(2, 0).map(lambda tensor: tensor.requires_grad_())
    write_ply(tmp_path / "a.ply", splats)
    assert len(read_ply(tmp_path / "a.ply")) == 2


def test_full_disk_keeps_the_old_file_and_leaves_no_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, make_splats(4, 0))
    old = path.read_bytes()
    write_bytes = Path.write_bytes

    def full(self: Path, content: bytes) -> int:
        write_bytes(self, content[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(DataError, match=r"a\.ply: cannot be written: No space left on device"):
        write_ply(path, make_splats(5, 0))
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_in_the_place_of_the_file_is_bad_data(tmp_path: Path) -> None:
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(DataError, match="cannot be written"):
        write_ply(tmp_path / "a.ply", make_splats(1, 0))


def test_reader_takes_any_order_other_types_and_further_elements(tmp_path: Path) -> None:
    splats = make_splats(6, 2)
    write_ply(tmp_path / "a.ply", splats)
    lines, table = parse(tmp_path / "a.ply")
    names = [line.split()[-1] for line in lines[3:]]
    order = np.random.default_rng(3).permutation(len(names))
    dtype = np.dtype([("label", "u1")] + [(names[i], "<f8") for i in order])
    rows = np.zeros(6, dtype)
    for i in order:
        rows[names[i]] = table[:, i]
    header = ["ply", "format binary_little_endian 1.0", "comment made by a test"]
    header += ["element vertex 6", "property uchar label"]
    header += [f"property double {names[i]}" for i in order]
    header += ["element face 0", "property list uchar int vertex_indices", "end_header", ""]
    path = tmp_path / "b.ply"
    path.write_bytes("\r\n".join(header).encode() + rows.tobytes())
    expected, found = read_ply(tmp_path / "a.ply"), read_ply(path)
    for name, tensor in expected.tensors().items():
        assert torch.equal(getattr(found, name), tensor), name


def edit(content: bytes, kind: str) -> bytes:
    """Return a broken variant of a PLY file."""
    return {
        "not a ply": b"solid cube\n" + content,
        "empty": b"",
        "ascii": content.replace(b"binary_little_endian", b"ascii"),
        "no end of header": content[:60],
        "truncated": content[:-1],
        "negative count": content.replace(b"vertex 5", b"vertex -5"),
        "huge count": content.replace(b"vertex 5", b"vertex 5" + b"0" * 30),
        "missing property": content.replace(b"property float rot_2\n", b""),
        "twice": content.replace(b"property float nx\n", b"property float x\n"),
        "list": content.replace(b"property float nx", b"property list uchar int nx"),
        "odd harmonics": content.replace(b"property float f_rest_8\n", b""),
        "no properties": b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nend_header\n",
    }[kind]


KINDS = [
    "not a ply", "empty", "ascii", "no end of header", "truncated", "negative count",
    "huge count", "missing property", "twice", "list", "odd harmonics", "no properties",
]  # fmt: skip


def test_harmonics_above_the_third_degree_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, make_splats(5, 3))
    header, body = path.read_bytes().split(b"end_header\n")
    more = "".join(f"property float f_rest_{i}\n" for i in range(45, 72)).encode()
    rows = np.frombuffer(body, "<f4").reshape(5, -1)
    wider = np.concatenate([rows, np.zeros((5, 27), "<f4")], axis=1)
    path.write_bytes(header + more + b"end_header\n" + wider.tobytes())
    with pytest.raises(DataError, match="has 72 f_rest properties; allowed: 0, 9, 24, 45"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("kind", KINDS)
def test_broken_files_are_bad_data_in_one_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.ply"
    write_ply(path, make_splats(5, 1))
    content = path.read_bytes()
    broken = edit(content, kind)
    assert broken != content
    path.write_bytes(broken)
    with pytest.raises(DataError) as caught:
        read_ply(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_bad_data(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot read"):
        read_ply(tmp_path / "absent.ply")


def write(kind: str, model: Any, out: Path, *counted: Any, **settings: Any) -> list[Path]:
    """Export with the options that are given; ``counted`` may be a list that gets the progress."""
    told = counted[0] if counted else []
    return export(kind, model, FACTS, Located(settings), out, lambda *n: told.append(n)).files


def test_ply_shows_the_moment_that_is_asked_for(tmp_path: Path) -> None:
    model, told = falling(make_splats(3, 1)), []
    target = tmp_path / "made" / "moment.ply"
    assert write("ply", model, target, told, time=0.25) == [target]
    assert torch.equal(read_ply(target).means, splats_at(model, 0.25).means)
    assert told == [(1, 1)]
    with pytest.raises(UsageError, match=r"does not end in \.ply"):
        write("ply", model, tmp_path / "moment.obj", time=0.25)


def test_sequence_spreads_its_frames_over_time(tmp_path: Path) -> None:
    model, told = falling(make_splats(3, 0)), []
    paths = write("ply-sequence", model, tmp_path / "run", told, frames=5)
    assert [path.name for path in paths] == [f"frame000{i}.ply" for i in range(1, 6)]
    assert sorted((tmp_path / "run").glob("*.ply")) == paths
    note = json.loads((tmp_path / "run" / "ply-sequence.json").read_text())
    assert note["frames"] == [path.name for path in paths] and note["whole"]
    for path, time in zip(paths, (0.0, 0.25, 0.5, 0.75, 1.0), strict=True):
        assert torch.equal(read_ply(path).means, splats_at(model, time).means)
    assert told == [(i, 5) for i in range(1, 6)]


def test_sequence_takes_a_given_time_and_a_single_frame(tmp_path: Path) -> None:
    model = falling(make_splats(2, 0))
    (path,) = write("ply-sequence", model, tmp_path / "a", time=0.9)
    assert torch.equal(read_ply(path).means, splats_at(model, 0.9).means)
    (path,) = write("ply-sequence", model, tmp_path / "b", frames=1)
    assert torch.equal(read_ply(path).means, splats_at(model, 0.0).means)


def test_sequence_refuses_to_mix_with_a_longer_one(tmp_path: Path) -> None:
    model = falling(make_splats(2, 0))
    write("ply-sequence", model, tmp_path, frames=4)
    write("ply-sequence", model, tmp_path, frames=4)
    with pytest.raises(DataError, match=r"2 frames of another sequence, frame0003\.ply"):
        write("ply-sequence", model, tmp_path, frames=2)


def test_sequence_leaves_frames_of_somebody_else_alone(tmp_path: Path) -> None:
    model = falling(make_splats(2, 0))
    (tmp_path / "frame0001.ply").write_text("mine")
    with pytest.raises(DataError, match=r"1 frames of another sequence, frame0001\.ply"):
        write("ply-sequence", model, tmp_path, frames=2)
    assert [path.name for path in tmp_path.iterdir()] == ["frame0001.ply"]
    assert (tmp_path / "frame0001.ply").read_text() == "mine"


def test_a_sequence_on_a_full_disk_leaves_the_one_before(tmp_path: Path, monkeypatch: Any) -> None:
    """And a folder without one has none then, not the first frames."""
    before = write("ply-sequence", falling(make_splats(2, 0)), tmp_path / "a", frames=4)
    content, real, count = [path.read_bytes() for path in before], Path.write_bytes, [0]

    def fill(path: Path, data: bytes) -> int:
        count[0] += 1
        if not count[0] % 3:
            raise OSError(28, "No space left on device")
        return real(path, data)

    monkeypatch.setattr(Path, "write_bytes", fill)
    for name in ("a", "b"):
        with pytest.raises(DataError, match="No space left"):
            write("ply-sequence", falling(make_splats(3, 1)), tmp_path / name, frames=4)
        count[0] = 0
    assert [path.read_bytes() for path in before] == content
    assert not any((tmp_path / "b").iterdir()) and len(list((tmp_path / "a").iterdir())) == 5


def test_sequence_refuses_a_file_and_no_frames(tmp_path: Path) -> None:
    model = falling(make_splats(2, 0))
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match="must name a folder"):
        write("ply-sequence", model, tmp_path / "file", frames=2)
    with pytest.raises(UsageError, match="--frames"):
        write("ply-sequence", model, tmp_path / "run")


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        ("ply", {"time": 1.5}, "time is 1.5; allowed: 0 to 1"),
        ("ply", {"time": float("nan")}, "time is NaN; allowed"),
        ("ply", {"frames": 3}, "frames is not for --format ply, which takes time; drop it"),
        ("ply-sequence", {"time": -0.1}, "time is -0.1; allowed: 0 to 1"),
        ("ply-sequence", {"frames": -1}, "frames is -1; allowed: 1 or more"),
        ("ply-sequence", {"frames": 2, "time": 0.5}, "--time and --frames are both given"),
        ("plys", {}, "unknown exports 'plys'; did you mean 'ply'?"),
    ],
)
def test_impossible_options_are_refused(
    tmp_path: Path, kind: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError, match=re.escape(message)) as caught:
        write(kind, falling(make_splats(2, 0)), tmp_path / "a.ply", **options)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["ply", "ply-sequence"])
def test_what_a_ply_cannot_carry_is_refused(tmp_path: Path, kind: str) -> None:
    splats, options = make_splats(2, 0), {"time": 0.5}
    axes, features = torch.eye(3).expand(2, 3, 3), torch.zeros(2, 4)
    with pytest.raises(UsageError, match=f"--format {kind} cannot carry axes .* nor features"):
        write(kind, falling(splats, axes=axes, features=features), tmp_path / "a.ply", **options)
    with pytest.raises(UsageError, match="cannot carry features beside the colours of this run"):
        write(kind, falling(splats, features=features), tmp_path / "a.ply", **options)
    assert list(tmp_path.iterdir()) == []
    (path,) = write(kind, falling(splats), tmp_path / "a.ply", **options)
    assert torch.equal(read_ply(path).means, splats_at(falling(splats), 0.5).means)


def test_formats_are_found_without_loading_torch() -> None:
    assert {"ply", "ply_sequence"} <= set(plugins.names("gsdmsr_cli.exports"))
    code = "import sys, gsdmsr_cli.exports; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
