"""A PLY for Brush, read by a reader written here from how Brush adds up what it finds."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from export_checks import Array, angles, unit, usual_splats
from motion_checks import model_of

from gsdmsr_cli.exports import Written, export
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._ply import read_ply
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.geometry import covariance
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.options.strict import Located

TYPES = {"float": "<f4", "uchar": "u1", "ushort": "<u2"}
LARGEST = {"u1": 254, "<u2": 65534}
NAMES = [*"xyz", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


class Swimming(Layer):
    """Splats that sway, grow and turn; and fade where that is asked for."""

    def __init__(self, fading: bool = False) -> None:
        super().__init__()
        self.fading = fading

    def at(self, moment: Moment, instant: Instant) -> Moment:
        splats, t = moment.splats, torch.tensor(instant.time)
        quats = torch.nn.functional.normalize(splats.quats, dim=1)
        moved = replace(
            splats,
            means=splats.means + torch.sin(7 * t + splats.means.flip(1)),
            quats=quats + t * quats.roll(1, 0),
            log_scales=splats.log_scales + 0.3 * t * splats.means,
            logit_opacities=splats.logit_opacities - (3 * t if self.fading else 0),
        )
        return Moment(moved)


def write(splats: Splats, out: Path, layer: Layer | None = None, **settings: Any) -> Written:
    facts: Facts = SimpleNamespace(bound=2.0, frames=7)
    return export("brush-ply", model_of(splats, layer or Swimming()), facts, Located(settings), out)


def seen_splats(count: int, degree: int) -> Splats:
    splats = usual_splats(count, degree)
    splats.logit_opacities.clamp_(-4, 4)
    return splats


def elements_of(path: Path) -> dict[str, Array]:
    """Return the rows of every element of a PLY, in the order of the file."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    found, at = {}, 0
    for block in "\n".join(lines[2:]).split("element ")[1:]:
        (name, count), *properties = (line.split() for line in block.splitlines())
        kind = np.dtype([(words[2], TYPES[words[1]]) for words in properties])
        found[name] = np.frombuffer(body, kind, int(count), at)
        at += found[name].nbytes
    assert at == len(body)
    return found


def frames_of(path: Path) -> list[Array]:
    """Return means, log scales and quaternions of every moment, (N, 10) float64 each."""
    elements = elements_of(path)
    base = np.stack([elements["vertex"][name].astype(float) for name in NAMES], axis=1)
    frames, limits = [], {"min": np.zeros(10), "max": np.ones(10)}
    for name, rows in list(elements.items())[1:]:
        assert list(rows.dtype.names or ()) == NAMES
        values = np.array(rows.tolist(), float).reshape(len(rows), 10)
        kind = rows.dtype["x"].str.replace("|", "")
        if (limit := re.fullmatch(r"meta_delta_(min|max)_\d+", name)) is not None:
            limits[limit[1]] = values[0]
            continue
        assert re.fullmatch(r"delta_vertex_\d+", name)
        shares = values / LARGEST.get(kind, 1)
        frames.append(base + shares * (limits["max"] - limits["min"]) + limits["min"])
    return frames


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 40])
@pytest.mark.parametrize(("bits", "off"), [(8, 2e-2), (16, 1e-4), (32, 1e-5)])
def test_every_moment_is_read_back(
    tmp_path: Path, count: int, degree: int, bits: int, off: float
) -> None:
    splats = seen_splats(count, degree)
    result = write(splats, tmp_path / "made" / "a.ply", bits=bits, frames=5)
    assert (result.splats, result.lost) == (count, [])
    frames = frames_of(result.files[0])
    assert len(frames) == 5
    for place, frame in enumerate(frames):
        wanted = Swimming().at(Moment(splats), Instant(place / 4)).splats
        np.testing.assert_allclose(frame[:, :3], wanted.means, atol=off)
        np.testing.assert_allclose(np.sort(frame[:, 3:6]), np.sort(wanted.log_scales), atol=off)
        found = covariance(torch.tensor(frame[:, 6:]), torch.tensor(frame[:, 3:6]))
        true = covariance(wanted.quats.double(), wanted.log_scales.double())
        size = true.flatten(1).norm(dim=1)[:, None, None]
        torch.testing.assert_close(found / size, true / size, rtol=0, atol=8 * off)
    base = read_ply(result.files[0])  # programs that know nothing of moments show the first one
    np.testing.assert_allclose(base.means, splats.means + torch.sin(splats.means.flip(1)), 1e-5)
    np.testing.assert_allclose(base.sh, splats.sh, atol=1e-5)
    np.testing.assert_allclose(base.logit_opacities, splats.logit_opacities, atol=1e-4)


def test_there_are_as_many_moments_as_the_run_has_frames(tmp_path: Path) -> None:
    (path,) = write(seen_splats(3, 0), tmp_path / "a.ply").files
    assert len(frames_of(path)) == 7
    assert elements_of(path)["delta_vertex_00000"].itemsize == 20


def test_splats_that_stand_still_are_exact(tmp_path: Path) -> None:
    """Limits that are the same leave nothing to divide by."""
    splats = seen_splats(4, 0)
    still = model_of(splats, Swimming(), moving=0)
    facts: Facts = SimpleNamespace(bound=2.0, frames=3)
    export("brush-ply", still, facts, Located({}), tmp_path / "a.ply")
    for frame in frames_of(tmp_path / "a.ply"):
        np.testing.assert_allclose(frame[:, :3], splats.means, atol=1e-6)
        assert angles(frame[:, 6:], unit(read_ply(tmp_path / "a.ply").quats)).max() < 1e-3


def test_opacities_that_change_are_refused_unless_lossy(tmp_path: Path) -> None:
    splats, out = seen_splats(4, 0), tmp_path / "a.ply"
    with pytest.raises(UsageError, match="cannot carry opacities that change in time"):
        write(splats, out, Swimming(fading=True))
    assert not list(tmp_path.iterdir())
    result = write(splats, out, Swimming(fading=True), lossy=True, frames=3)
    assert result.lost == ["opacities that change in time"]
    mean = torch.stack([(splats.logit_opacities - 1.5 * i).sigmoid() for i in range(3)]).mean(dim=0)
    np.testing.assert_allclose(read_ply(out).logit_opacities.sigmoid(), mean, atol=1e-4)


def test_axes_units_harmonics_and_opacities_are_those_asked_for(tmp_path: Path) -> None:
    splats = seen_splats(30, 2)
    kept = splats.logit_opacities.sigmoid() >= 0.5
    wishes = {"axes": "y-up", "scale": 3.0, "min_opacity": 0.5, "sh_degree": 1}
    result = write(splats, tmp_path / "a.ply", **wishes)
    assert 0 < result.splats == int(kept.sum()) < 30
    assert read_ply(result.files[0]).sh_degree == 1
    for place, frame in enumerate(frames_of(result.files[0])):
        moved = Swimming().at(Moment(splats), Instant(place / 6)).splats
        x, y, z = moved.means[kept].unbind(1)
        np.testing.assert_allclose(frame[:, :3], 3 * torch.stack([x, z, -y], dim=1), atol=3e-4)


def test_values_that_are_not_finite_other_names_and_numbers_are_refused(tmp_path: Path) -> None:
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        splats = seen_splats(5, 0)
        getattr(splats, name)[1] = float("nan")
        with pytest.raises(DataError, match="splats hold NaN"):
            write(splats, tmp_path / "a.ply")
    for settings, told in (
        ({"bits": 12}, "bits is 12; allowed: 8 or 16"),
        ({"frames": 0}, "frames is 0; allowed: 1 or more"),
    ):
        with pytest.raises(UsageError, match=told):
            write(seen_splats(5, 0), tmp_path / "a.ply", **settings)
    with pytest.raises(UsageError, match="--format brush-ply writes one file, but"):
        write(seen_splats(5, 0), tmp_path / "a.brush")
    assert not list(tmp_path.iterdir())
