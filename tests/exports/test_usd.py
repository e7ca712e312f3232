"""OpenUSD reads what is written; without it these tests are skipped, but for one."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from export_checks import usual_splats
from motion_checks import model_of

from gsdmsr_cli.exports import Written, export
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.gaussians.fading import fade
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.geometry import covariance
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.options.strict import Located


class Drifting(Layer):
    """Splats that drift, turn and fade."""

    def at(self, moment: Moment, instant: Instant) -> Moment:
        splats, t = moment.splats, torch.tensor(instant.time)
        moved = replace(
            splats,
            means=splats.means + torch.sin(7 * t + splats.means.flip(1)),
            quats=torch.nn.functional.normalize(splats.quats, dim=1) + t * splats.quats.roll(1, 0),
            logit_opacities=fade(splats.logit_opacities, t.expand(len(splats))),
        )
        return Moment(moved)


def write(splats: Splats, out: Path, moving: int | None = None, **settings: Any) -> Written:
    facts: Facts = SimpleNamespace(bound=2.0, frames=7)
    model = model_of(splats, Drifting(), moving=moving)
    return export("usd", model, facts, Located(settings), out)


def seen_splats(count: int, degree: int) -> Splats:
    splats = usual_splats(count, degree)
    splats.logit_opacities.clamp_(-4, 4)
    return splats


def opened(path: Path) -> tuple[Any, Any]:
    """Return a stage, and the splats that it shows by default; or skip the test."""
    usd = pytest.importorskip("pxr.Usd", reason="no OpenUSD: pip install usd-core")
    from pxr import UsdVol

    stage = usd.Stage.Open(str(path))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert field and stage.GetDefaultPrim().GetTypeName() == "ParticleField3DGaussianSplat"
    return stage, field


def read(field: Any, time: float) -> Splats:
    quats = [[q.GetReal(), *q.GetImaginary()] for q in field.GetOrientationsAttr().Get(time)]
    degree = field.GetRadianceSphericalHarmonicsDegreeAttr().Get(time)

    def tensor(attribute: Any, *shape: int) -> torch.Tensor:
        return torch.from_numpy(np.array(attribute.Get(time), np.float32)).reshape(*shape)

    return Splats(
        means=tensor(field.GetPositionsAttr(), -1, 3),
        quats=torch.tensor(quats).reshape(-1, 4),
        log_scales=tensor(field.GetScalesAttr(), -1, 3).log(),
        logit_opacities=tensor(field.GetOpacitiesAttr(), -1).logit(),
        sh=tensor(
            field.GetRadianceSphericalHarmonicsCoefficientsAttr(),
            len(quats), (degree + 1) ** 2, 3,
        ),
    )  # fmt: skip


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 40])
def test_every_moment_is_read_back(tmp_path: Path, count: int, degree: int) -> None:
    pytest.importorskip("pxr.Usd", reason="no OpenUSD: pip install usd-core")
    splats = seen_splats(count, degree)
    result = write(splats, tmp_path / "made" / "a.usdc", frames=5, fps=30.0)
    assert (result.splats, result.lost) == (count, [])
    stage, field = opened(result.files[0])
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 4)
    assert stage.GetTimeCodesPerSecond() == 30 and list(tmp_path.rglob("*.usd*")) == result.files
    for frame in range(5):
        found = read(field, frame)
        wanted = Drifting().at(Moment(splats), Instant(frame / 4)).splats
        assert found.sh_degree == degree
        for name in ("means", "log_scales", "logit_opacities", "sh"):
            pair = getattr(found, name), getattr(wanted, name)
            if name == "log_scales":  # half turns may change axes' order, never the splat
                pair = pair[0].sort(dim=1).values, pair[1].sort(dim=1).values
            torch.testing.assert_close(*pair, rtol=0, atol=2e-4, msg=name)
        pair = [covariance(each.quats, each.log_scales) for each in (found, wanted)]
        torch.testing.assert_close(*pair, rtol=1e-3, atol=1e-5)
        low, high = np.array(field.GetExtentAttr().Get(frame))
        assert not count or (
            (found.means.numpy() > low).all() and (found.means.numpy() < high).all()
        )


def test_what_does_not_change_has_one_value(tmp_path: Path) -> None:
    pytest.importorskip("pxr.Usd", reason="no OpenUSD: pip install usd-core")
    splats = seen_splats(4, 1)
    _, field = opened(write(splats, tmp_path / "a.usda").files[0])
    assert field.GetPositionsAttr().GetNumTimeSamples() == 7
    assert field.GetScalesAttr().GetNumTimeSamples() == 0
    assert field.GetRadianceSphericalHarmonicsCoefficientsAttr().GetNumTimeSamples() == 0
    _, field = opened(write(splats, tmp_path / "b.usda", moving=0).files[0])
    assert field.GetPositionsAttr().GetNumTimeSamples() == 0
    torch.testing.assert_close(read(field, 3.0).means, splats.means)


@pytest.mark.parametrize(("axes", "up"), [("z-up", "Z"), ("y-up", "Y")])
def test_axes_units_and_opacities_are_those_asked_for(tmp_path: Path, axes: str, up: str) -> None:
    pytest.importorskip("pxr.Usd", reason="no OpenUSD: pip install usd-core")
    splats = seen_splats(30, 2)
    kept = splats.logit_opacities.sigmoid() >= 0.5
    wishes = {"axes": axes, "scale": 3.0, "min_opacity": 0.5, "sh_degree": 1}
    result = write(splats, tmp_path / "a.usd", frames=3, **wishes)
    assert 0 < result.splats == int(kept.sum()) < 30
    stage, field = opened(result.files[0])
    assert stage.GetMetadata("upAxis") == up
    x, y, z = Drifting().at(Moment(splats), Instant(0.5)).splats.means[kept].unbind(1)
    wanted = 3 * torch.stack([x, z, -y] if up == "Y" else [x, y, z], dim=1)
    torch.testing.assert_close(read(field, 1.0).means, wanted, rtol=0, atol=1e-4)
    assert read(field, 1.0).sh_degree == 1


def test_values_that_are_not_finite_and_other_names_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("pxr.Usd", reason="no OpenUSD: pip install usd-core")
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        splats = seen_splats(5, 0)
        getattr(splats, name)[1] = float("nan")
        with pytest.raises(DataError, match="splats hold NaN"):
            write(splats, tmp_path / "a.usdc")
    with pytest.raises(UsageError, match=r"does not end in \.usd, \.usda, \.usdc"):
        write(seen_splats(5, 0), tmp_path / "a.usdz")
    assert not list(tmp_path.iterdir())
    (tmp_path / "b.usdc").mkdir()
    with pytest.raises(DataError, match="cannot be written"):
        write(seen_splats(5, 0), tmp_path / "b.usdc")


def test_without_openusd_a_line_says_how_to_get_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    for name in [name for name in sys.modules if name.startswith("pxr.")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(UsageError, match=r"needs OpenUSD 26.3 .* pip install 'gsdmsr\[usd\]'"):
        write(seen_splats(5, 0), tmp_path / "a.usdc")
    assert not list(tmp_path.iterdir())
