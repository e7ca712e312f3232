"""What a training is expected to take, and who is warned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.training.memory import Estimate, estimate, warning


def test_every_part_grows_with_what_it_is_of(tiny_scene: Path) -> None:
    views, preset = read_scene(tiny_scene).split("train"), load_preset("dnerf", None, [])
    one, two = estimate(views, preset, 1), estimate(views, preset, 2)
    assert one.processes == 0 and two.processes > 45 << 20
    assert two.drawing == 2 * one.drawing and two.splats == one.splats
    density = replace(preset.density, cap=2 * preset.density.cap)
    assert estimate(views, replace(preset, density=density), 1).splats == 2 * one.splats
    none = replace(preset, data=replace(preset.data, cache_mib=0))
    assert estimate(views, none, 1).pictures == 0
    assert estimate(views * 2, preset, 1).pictures == 2 * one.pictures


def test_a_warning_says_what_is_short_and_what_to_lower() -> None:
    expected = Estimate(300 << 20, 200 << 20, 0, 10 << 20)
    assert warning(expected, 510 << 20) is None and warning(expected, None) is None
    assert warning(expected, (510 << 20) - 1) == (
        "this training may take 510 MiB (pictures 300, splats 200, drawing 10), and 510 MiB are "
        "available; lower data.cache_mib, density.cap or training.views_per_step, or raise "
        "data.downscale"
    )


def test_a_training_warns_before_it_starts(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsdmsr_cli.commands import train
    from gsdmsr_cli.ground import limits

    options = ["splats.count=20", "splats.start=box", "training.threads=1"]
    given = read_scene(tiny_scene), load_preset("dnerf", None, options), "cpu"
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 50)
    train._prepare(*given)
    assert "available" not in capsys.readouterr().err
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 20)
    train._prepare(*given)
    said = capsys.readouterr().err
    assert "warning: this training may take" in said and "and 1 MiB are available" in said
