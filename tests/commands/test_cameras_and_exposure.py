"""A capture with wrong cameras and colours, from training to a report, a film and an export."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from walking_capture import write_capture

LAYERS = "layers=[{name: cameras, since: 0.1}, {name: exposure}]"


@pytest.fixture
def run(gsdmsr: Callable[..., int], tmp_path: Path) -> Path:
    """A run with both layers."""
    data, out = tmp_path / "walk", tmp_path / "run"
    write_capture(data, size=32, frames=32, pixels=1.0, drift=0.1, seed=0)
    given = "--preset", "dnerf", "--steps", 40, "--threads", 1, "--set", "splats.count=200"
    assert gsdmsr("train", "--data", data, "--out", out, *given, "--set", LAYERS) == 0
    return out


def test_reports_say_how_views_are_drawn_and_others_take_the_run(
    run: Path, gsdmsr: Callable[..., int], tmp_path: Path
) -> None:
    assert gsdmsr("eval", run, "--split", "val", "--report") == 0
    document = json.loads((run / "eval" / "metrics.json").read_text())
    told = document["protocol"]["views"]
    for name in ("cameras", "exposure"):
        counts = [told[name][key] for key in ("own", "of_neighbours", "none")]
        assert counts == [0, 8, 0] and told[name]["per"] == "picture"
    (page,) = (run / "eval").glob("*.html")
    assert "of the split 0 have their own, 8 that of neighbours, 0 none" in page.read_text()
    assert gsdmsr("render", run, "--path", "val") == 0
    for format_, suffix in (("ply", "ply"), ("html", "html"), ("compact", "packed")):
        out = tmp_path / f"run.{suffix}"
        assert gsdmsr("export", run, "--format", format_, "--out", out) == 0
    psnr = document["aggregate"]["psnr"]
    packed = tmp_path / "run.packed"
    assert gsdmsr("eval", packed, "--split", "val") == 0
    again = json.loads((packed / "eval" / "metrics.json").read_text())
    found = again["protocol"]["views"]
    offsets = [views["motion"].pop("time_offsets") for views in (told, found)]
    assert offsets[1] == pytest.approx(offsets[0], abs=1e-3)  # rounded where they are packed
    assert found == told and abs(again["aggregate"]["psnr"] - psnr) < 0.5
