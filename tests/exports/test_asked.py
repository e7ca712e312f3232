"""What every export can be asked for: axes, units, harmonics, which splats, what may be lost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from export_checks import usual_splats, write

from gsdmsr_cli.exports._ply import read_ply
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.geometry import covariance, sh_basis

TURNS = {
    "scene": lambda x, y, z: (x, y, z),
    "z-up": lambda x, y, z: (x, y, z),
    "y-up": lambda x, y, z: (x, z, -y),
    "opencv": lambda x, y, z: (x, -z, y),
}
"""Where a point of a world with z up lies in each of the axes."""


def written(tmp_path: Path, splats: Splats, **settings: Any) -> Splats:
    (path,) = write("ply", splats, tmp_path / "a.ply", **settings).files
    return read_ply(path)


def turned(points: torch.Tensor, axes: str) -> torch.Tensor:
    return torch.stack(TURNS[axes](*points.unbind(-1)), dim=-1)


@pytest.mark.parametrize("axes", TURNS)
def test_axes_and_units_are_those_that_were_asked_for(tmp_path: Path, axes: str) -> None:
    splats = usual_splats(9, 3)
    found = written(tmp_path, splats, axes=axes, scale=2.0)
    torch.testing.assert_close(found.means, 2 * turned(splats.means, axes))
    rotation = turned(torch.eye(3), axes).T
    expected = 4 * rotation @ covariance(splats.quats, splats.log_scales) @ rotation.T
    torch.testing.assert_close(covariance(found.quats, found.log_scales), expected)
    directions = torch.nn.functional.normalize(torch.randn(20, 3), dim=1)
    before = torch.einsum("dk,nkc->ndc", sh_basis(directions, 3), splats.sh)
    after = torch.einsum("dk,nkc->ndc", sh_basis(turned(directions, axes), 3), found.sh)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-5)


def test_what_is_not_asked_for_stays_bit_by_bit(tmp_path: Path) -> None:
    splats = usual_splats(5, 2)
    found = written(tmp_path, splats, axes="scene")
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(getattr(found, name), getattr(splats, name)), name


@pytest.mark.parametrize(("degree", "limit", "left"), [(3, 1, 1), (3, 0, 0), (1, 2, 1)])
def test_harmonics_of_higher_degrees_are_left_out(
    tmp_path: Path, degree: int, limit: int, left: int
) -> None:
    splats = usual_splats(4, degree)
    found = written(tmp_path, splats, sh_degree=limit)
    assert torch.equal(found.sh, splats.sh[:, : (left + 1) ** 2])


def test_faint_splats_are_left_out_and_the_others_counted(tmp_path: Path) -> None:
    splats = usual_splats(50, 0)
    kept = splats.logit_opacities.sigmoid() >= 0.5
    result = write("ply", splats, tmp_path / "a.ply", min_opacity=0.5)
    assert 0 < result.splats == int(kept.sum()) < 50
    assert torch.equal(read_ply(result.files[0]).means, splats.means[kept])


def test_a_faint_limit_does_not_hide_values_that_are_not_finite(tmp_path: Path) -> None:
    splats = usual_splats(5, 0)
    splats.logit_opacities[2] = float("nan")
    with pytest.raises(DataError, match=r"1 of \d splats hold NaN"):
        write("ply", splats, tmp_path / "a.ply", min_opacity=0.1)
    assert not list(tmp_path.iterdir())


def test_what_may_be_lost_is_told_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    splats, beside = usual_splats(3, 1), {"features": torch.zeros(3, 4)}
    with pytest.raises(
        UsageError, match=r"features beside the colours .* leave it out with --lossy"
    ):
        write("ply", splats, tmp_path / "a.ply", beside)
    result = write("ply", splats, tmp_path / "a.ply", beside, lossy=True)
    assert result.lost == ["features beside the colours"]
    assert (
        "cannot carry features beside the colours of this run: left out" in capsys.readouterr().err
    )
    assert torch.equal(read_ply(result.files[0]).means, splats.means)


def test_what_no_splat_can_do_without_is_refused_all_the_same(tmp_path: Path) -> None:
    beside = {"axes": torch.eye(3).expand(3, 3, 3)}
    with pytest.raises(UsageError, match="cannot carry axes that stand in place") as caught:
        write("ply", usual_splats(3, 1), tmp_path / "a.ply", beside, lossy=True)
    assert "--lossy" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": "x-up"}, 'axes is "x-up"; allowed: '),
        ({"scale": 0.0}, "scale is 0.0; allowed: more than 0"),
        ({"scale": -1.0}, "scale is -1.0; allowed: more than 0"),
        ({"scale": float("inf")}, "scale is Infinity; allowed: a number"),
        ({"sh_degree": 4}, "sh_degree is 4; allowed: 0 to 3"),
        ({"min_opacity": 1.1}, "min_opacity is 1.1; allowed: 0 to 1"),
        ({"lossy": "yes"}, 'lossy is "yes"; allowed: true or false'),
    ],
)
def test_impossible_wishes_are_refused(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UsageError) as caught:
        write("ply", usual_splats(2, 0), tmp_path / "a.ply", **options)
    assert message in str(caught.value) and not list(tmp_path.iterdir())


def test_every_file_of_a_sequence_is_turned(tmp_path: Path) -> None:
    splats = usual_splats(3, 0)
    paths = write("ply-sequence", splats, tmp_path / "s", frames=2, axes="y-up").files
    for path, fallen in zip(paths, (0.0, 1.0), strict=True):
        where = turned(splats.means + torch.tensor([0.0, fallen, 0.0]), "y-up")
        np.testing.assert_allclose(read_ply(path).means, where, atol=1e-6)


@pytest.mark.parametrize("wish", [{"axes": "y-up"}, {"min_opacity": 0.5}, {"lossy": True}])
def test_a_run_in_few_bytes_is_the_run_and_takes_no_wishes(
    tmp_path: Path, wish: dict[str, Any]
) -> None:
    (name,) = wish
    with pytest.raises(UsageError, match=f"{name} is not for --format compact, which takes tol"):
        write("compact", usual_splats(3, 0), tmp_path / "run", **wish)
    assert not list(tmp_path.iterdir())
