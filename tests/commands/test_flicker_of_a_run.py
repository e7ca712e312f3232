"""gsdmsr eval says how much consecutive pictures flicker, in all that it writes."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

Gsdmsr = Callable[..., int]


@pytest.fixture
def run(gsdmsr: Gsdmsr, rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run of one camera, which is held out at four of the moments."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    layout = rig / "transforms_test.json"
    document = json.loads(layout.read_text())
    camera = json.loads((rig / "transforms_train.json").read_text())["frames"][0]
    for frame in document["frames"]:
        frame["transform_matrix"] = camera["transform_matrix"]
    layout.write_text(json.dumps(document))
    folder = tmp_path / "run"
    options = "--set=splats.count=100", "--set=density.cap=200", "--steps=12"
    assert gsdmsr("train", "--data", rig, "--out", folder, "--preset=dnerf", *options) == 0
    return folder


def test_flicker_is_measured_told_and_gated(
    run: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    capsys.readouterr()
    wishes = "--background", "both", "--report", "--json"
    assert gsdmsr("eval", run, *wishes, "--fail-over", "flicker=1") == 0
    document = json.loads(capsys.readouterr().out)
    for over in (document, document["backgrounds"]["black"]):
        found = {name: entry["value"] for name, entry in over["aggregate"].items() if "fli" in name}
        assert found.keys() == {"flicker", "flicker_true", "flicker_excess"}
        assert all(0 <= found[name] < 0.2 for name in ("flicker", "flicker_true"))
        assert found["flicker_excess"] == found["flicker"] - found["flicker_true"]
        assert over["consecutive"]["pairs"] >= 4 and 0.5 < over["consecutive"]["pixels"] <= 1
    page = (run / "eval" / "report.html").read_text(encoding="utf-8")
    assert page.count('data-of="aggregate.flicker_true.value"') == 2  # a tile and a row
    assert "| flicker_excess |" in (run / "eval" / "report.md").read_text(encoding="utf-8")
    assert gsdmsr("eval", run, "--fail-over", "flicker=0", "--out", tmp_path / "again") == 4
    told = capsys.readouterr()
    assert "flicker is " in told.err and "flicker_true" in told.out
