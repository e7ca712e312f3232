"""What gsdmsr train does about the flow between pictures: where it is kept, what is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from gsdmsr_cli.runs.outputs import FLOW_FILE

Gsdmsr = Callable[..., int]


def test_train_keeps_flow_in_the_run_and_overwrite_makes_it_anew(
    gsdmsr: Gsdmsr, rig: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    command = "train", "--data", rig, "--out", run, "--preset", "fourier", "--steps", "12"
    options = ("--set", "density.prune_scale=10", "--set", "training.low_resolution_until=0")
    assert gsdmsr(*command, *options) == 0
    kept = {path.name: path.stat().st_mtime_ns for path in (run / "flow").iterdir()}
    assert kept and all(FLOW_FILE.fullmatch(name) for name in kept)
    assert gsdmsr(*command, *options, "--overwrite") == 0
    again = {path.name: path.stat().st_mtime_ns for path in (run / "flow").iterdir()}
    assert again.keys() == kept.keys() and not set(again.values()) & set(kept.values())


def test_train_says_that_there_is_nothing_to_compare(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = "--data", tiny_scene, "--out", tmp_path / "run", "--preset", "fourier"
    assert gsdmsr("train", *given, "--dry-run") == 0
    assert "the term flow of the loss is left out: 0 of 12 train views" in capsys.readouterr().err
