"""A .splatv, played by a reader written here from what the players' shaders do with its texels."""

from __future__ import annotations

import json
import math
import re
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from export_checks import Array, Falling, angles, unit, usual_splats
from motion_checks import model_of
from node_packages import node, package
from torch import Tensor

from gsdmsr_cli.exports import Written, export
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._lifetimes import ALWAYS, gaussians_of
from gsdmsr_cli.gaussians.fading import fade
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.moving.playing import exponents_of
from gsdmsr_cli.options.strict import Located

BOUND = 2.0
SH_C0 = 0.28209479177387814
TIMES = (0.0, 0.3, 0.5, 0.8, 1.0)


class Thrown(Layer):
    """Splats on cubics of time that turn at constant rates, and live as they are told."""

    def __init__(self, count: int, lives: Tensor | None = None, wobble: float = 0.0) -> None:
        super().__init__()
        source = torch.Generator().manual_seed(5)
        self.path = 0.5 * torch.randn(3, count, 3, generator=source)
        self.rate = 0.2 * torch.randn(count, 4, generator=source)
        self.times, self.wobble = lives, wobble

    def at(self, moment: Moment, instant: Instant) -> Moment:
        t, splats = instant.time, moment.splats
        way = self.path[0] * t + self.path[1] * t**2 + self.path[2] * t**3
        way = way + self.wobble * math.sin(25 * t)
        quats = torch.nn.functional.normalize(splats.quats, dim=1) + (t - 0.5) * self.rate
        logits = splats.logit_opacities
        if self.times is not None:
            logits = fade(logits, exponents_of(self.times, t))
        moved = replace(splats, means=splats.means + way, quats=quats, logit_opacities=logits)
        return Moment(moved)

    def lives(self, splats: Splats) -> Tensor | None:
        return self.times


@dataclass(frozen=True)
class Shown:
    """What a player draws at a time; opacities with what the life leaves of them."""

    means: Array
    quats: Array
    scales: Array
    colours: Array
    opacities: Array


def parts_of(path: Path) -> tuple[dict[str, Any], bytes]:
    content = path.read_bytes()
    magic, length = struct.unpack("<II", content[:8])
    assert magic == 0x674B
    (chunk,) = json.loads(content[8 : 8 + length])
    texels = content[8 + length :]
    assert chunk["type"] == "splat" and chunk["size"] == len(texels)
    assert chunk["texwidth"] == 4096 and 16 * 4096 * chunk["texheight"] == len(texels)
    return chunk, texels


def played(path: Path, time: float) -> Shown:
    """Do what the vertex shader does: half floats in pairs, the first one in the lower bits."""
    _, texels = parts_of(path)
    words = np.frombuffer(texels, "<u4").reshape(-1, 16)
    words = words[words[:, 11:12].any(axis=1) | words[:, 15:].any(axis=1)]  # the row's rest is zero

    def pairs(*columns: int) -> Array:
        chosen = words[:, list(columns)]
        halves = np.stack([chosen & 0xFFFF, chosen >> 16], axis=2).astype("<u2")
        return halves.view("<f2").reshape(len(words), 2 * len(columns)).astype(float)

    means = words[:, :3].copy().view("<f4").astype(float)
    quats, scales = pairs(3, 4), pairs(5, 6)[:, :3]
    rgba = np.stack([words[:, 7] >> shift & 255 for shift in (0, 8, 16, 24)], axis=1) / 255
    path_, rate, (centre, width) = pairs(8, 9, 10, 11, 12), pairs(13, 14), pairs(15).T
    dt = (time - centre)[:, None]
    moved = means + path_[:, :3] * dt + path_[:, 3:6] * dt**2 + path_[:, 6:9] * dt**3
    turned = quats + rate * dt
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    left = np.exp(-((dt[:, 0] / width) ** 2))
    return Shown(moved, turned, scales, rgba[:, :3], rgba[:, 3] * left)


def write(splats: Splats, layer: Layer, out: Path, frames: int = 20, **settings: Any) -> Written:
    facts: Facts = SimpleNamespace(bound=BOUND, frames=frames)
    return export("splatv", model_of(splats, layer), facts, Located(settings), out)


def seen_splats(count: int, degree: int) -> Splats:
    """Return splats that a viewer with bytes for colours can show, none of them too faint."""
    splats = usual_splats(count, degree)
    splats.sh[:, 0].clamp_(-0.5 / SH_C0, 0.5 / SH_C0)
    splats.logit_opacities.clamp_(-4, 4)
    return splats


def turned_by(found: Array, wanted: Array) -> Array:
    """Return by what angles splats differ, which half turns about their own axes do not change."""
    w, x, y, z = found.T
    halves = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    return np.min([angles(np.stack(half, axis=1), wanted) for half in halves], axis=0)


def expected_at(splats: Splats, layer: Layer, time: float) -> Splats:
    return layer.at(Moment(splats), Instant(time)).splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 1100])
def test_cubics_are_played_as_they_were(tmp_path: Path, count: int, degree: int) -> None:
    splats, layer = seen_splats(count, degree), Thrown(count)
    result = write(splats, layer, tmp_path / "made" / "a.splatv", sh_degree=0)
    assert (result.splats, result.lost) == (count, [])
    for time in TIMES:
        shown, wanted = played(result.files[0], time), expected_at(splats, layer, time)
        assert len(shown.means) == count
        np.testing.assert_allclose(shown.means, wanted.means, atol=2e-3)
        np.testing.assert_allclose(shown.scales, wanted.log_scales.exp(), rtol=1e-3)
        np.testing.assert_allclose(shown.colours, 0.5 + SH_C0 * splats.sh[:, 0], atol=0.51 / 255)
        np.testing.assert_allclose(shown.opacities, wanted.logit_opacities.sigmoid(), atol=3e-3)
        if count:
            assert turned_by(shown.quats, unit(wanted.quats)).max() < math.radians(0.2), time


def test_a_life_that_is_a_gaussian_stays_that_gaussian(tmp_path: Path) -> None:
    splats = seen_splats(50, 0)
    centres, durations = torch.rand(50), torch.rand(50) - 2.0
    lives = torch.stack([centres, centres, durations, durations], dim=1)
    layer = Thrown(50, lives)
    result = write(splats, layer, tmp_path / "a.splatv")
    assert not [phrase for phrase in result.lost if "opacities" in phrase]
    for time in TIMES:
        shown, wanted = played(result.files[0], time), expected_at(splats, layer, time)
        opacities = wanted.logit_opacities.sigmoid().numpy()
        np.testing.assert_allclose(shown.opacities, opacities, atol=6e-3)
        there = opacities > 0.05
        np.testing.assert_allclose(shown.means[there], wanted.means[there], atol=4e-3)


def test_other_lives_become_the_nearest_gaussians_and_that_is_told(tmp_path: Path) -> None:
    splats = seen_splats(3, 0)
    splats.logit_opacities[:] = 3.0
    lives = torch.tensor([[0.2, 0.8, -4, -4], [-0.5, 1.5, -3, -3], [0.4, 0.4, -1, -3]])
    layer, out = Thrown(3, lives), tmp_path / "a.splatv"
    with pytest.raises(UsageError, match=r"opacities that change otherwise .* \(off by 0\.\d+ at"):
        write(splats, layer, out)
    assert write(splats, layer, out, lossy=True).lost
    times = torch.linspace(0, 1, 65)
    wanted = torch.stack([torch.exp(-exponents_of(lives, float(time))) for time in times])
    centres, widths = gaussians_of(lives)
    found = torch.exp(-(((times[:, None] - centres) / widths) ** 2))
    errors = (found - wanted).square().mean(dim=0).sqrt()
    assert widths[1] == ALWAYS and errors[1] < 1e-6
    grid = torch.cartesian_prod(torch.linspace(-0.5, 1.5, 201), torch.logspace(-2, 1, 301))
    shapes = torch.exp(-(((times - grid[:, :1]) / grid[:, 1:]) ** 2))
    for i in (0, 2):
        best = (shapes - wanted[:, i]).square().mean(dim=1).min().sqrt()
        assert 0.01 < errors[i] <= best + 1e-4, i


@pytest.mark.parametrize(
    ("layer", "degree", "told"),
    [
        (Thrown(5, wobble=0.3), 0, "paths that are no cubics of time (centres are off by "),
        (Thrown(5), 1, "colours that depend on the view (--sh-degree 0 leaves them out)"),
    ],
)
def test_what_is_lost_is_refused_unless_lossy(
    tmp_path: Path, layer: Layer, degree: int, told: str
) -> None:
    splats, out = seen_splats(5, degree), tmp_path / "a.splatv"
    with pytest.raises(UsageError, match=re.escape(told)):
        write(splats, layer, out)
    assert not list(tmp_path.iterdir())
    (phrase,) = write(splats, layer, out, lossy=True).lost
    assert told in phrase and len(played(out, 0.5).means) == 5


def test_how_far_paths_are_off_is_told_as_a_share_of_the_bound(tmp_path: Path) -> None:
    splats, layer = seen_splats(4, 0), Thrown(4, wobble=0.3)
    (phrase,) = write(splats, layer, tmp_path / "a.splatv", lossy=True).lost
    mean, most = map(float, re.findall(r"([\d.]+) %? ?(?:of|at most)", phrase.replace("%", "")))
    offs = [
        np.linalg.norm(
            played(tmp_path / "a.splatv", i / 19).means
            - expected_at(splats, layer, i / 19).means.numpy(),
            axis=1,
        )
        for i in range(20)
    ]
    assert mean == pytest.approx(100 * np.mean(offs) / BOUND, rel=0.05)
    assert most == pytest.approx(100 * np.max(offs) / BOUND, rel=0.05)


def test_axes_units_and_opacities_are_those_that_were_asked_for(tmp_path: Path) -> None:
    splats, layer = seen_splats(30, 0), Thrown(30)
    kept = splats.logit_opacities.sigmoid() >= 0.5
    wishes = {"axes": "y-up", "scale": 3.0, "min_opacity": 0.5}
    result = write(splats, layer, tmp_path / "a.splatv", **wishes)
    assert 0 < result.splats == int(kept.sum()) < 30
    for time in TIMES:
        x, y, z = expected_at(splats, layer, time).means[kept].unbind(1)
        found = played(result.files[0], time).means
        np.testing.assert_allclose(found, 3 * torch.stack([x, z, -y], dim=1), atol=6e-3)
    (camera,) = parts_of(result.files[0])[0]["cameras"]
    turn, place = np.array(camera["rotation"]), np.array(camera["position"])
    np.testing.assert_allclose(np.linalg.inv(turn) @ -place, [0, 0, 3 * 3 * BOUND], atol=1e-9)
    np.testing.assert_allclose(turn @ [0, -1, 0], [0, 1, 0], atol=1e-9)  # up is up


def test_splats_that_stand_still_never_vanish(tmp_path: Path) -> None:
    """Those that move come first, and are all there at 0.5; the others have no lives."""
    splats = seen_splats(6, 0)
    half = torch.full((4,), 0.5)
    layer = Thrown(4, torch.stack([half, half, half - 2, half - 2], dim=1))
    model = model_of(splats, layer, moving=4)
    facts: Facts = SimpleNamespace(bound=BOUND, frames=20)
    out = tmp_path / "a.splatv"
    export("splatv", model, facts, Located({"lossy": True}), out)
    opacities = splats.logit_opacities.sigmoid().numpy()
    for time in (0.0, 1.0):
        shown = played(out, time)
        np.testing.assert_allclose(shown.opacities[4:], opacities[4:], atol=3e-3)
        np.testing.assert_allclose(shown.means[4:], splats.means[4:], atol=1e-6)
        assert (shown.opacities[:4] < 0.4 * opacities[:4]).all()


def test_values_that_are_not_finite_and_other_names_are_refused(tmp_path: Path) -> None:
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        splats = seen_splats(5, 0)
        getattr(splats, name)[1] = float("nan")
        with pytest.raises(DataError, match="splats hold NaN"):
            write(splats, Falling(), tmp_path / "a.splatv")
    with pytest.raises(UsageError, match="--format splatv writes one file, but"):
        write(seen_splats(5, 0), Falling(), tmp_path / "a.splat")
    splats = seen_splats(5, 0)
    splats.log_scales[2] = 12.0
    with pytest.raises(UsageError, match=r"log_scales of 1 splats, outside -87 to 11.0899"):
        write(splats, Falling(), tmp_path / "a.splatv")
    assert not list(tmp_path.iterdir())


LOADER = """
import fs from "node:fs";
const { SplatvLoader, Scene } = await import(process.argv[2]);
globalThis.FileReader = class {
  readAsArrayBuffer(file) {
    file.arrayBuffer().then((buffer) => {
      this.result = buffer;
      this.onload({ target: this });
      this.onloadend();
    });
  }
};
const file = new Blob([fs.readFileSync(process.argv[3])]);
const { data } = await SplatvLoader.LoadFromFileAsync(file, new Scene(), null);
console.log(JSON.stringify([data.vertexCount, Array.from(data.data)]));
"""


def test_somebody_else_loads_the_same_texels(tmp_path: Path) -> None:
    gsplat = package("gsplat") / "dist" / "index.es.js"
    splats, out = seen_splats(1100, 0), tmp_path / "a.splatv"
    write(splats, Thrown(1100), out)
    (tmp_path / "load.mjs").write_text(LOADER, encoding="utf-8")
    count, words = json.loads(node(tmp_path / "load.mjs", gsplat.as_uri(), out))
    assert count == 2048
    assert np.array_equal(np.array(words, np.uint32), np.frombuffer(parts_of(out)[1], "<u4"))
