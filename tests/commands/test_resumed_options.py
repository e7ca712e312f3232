"""What the options of a resumed training may be."""

from __future__ import annotations

from pathlib import Path

import pytest
from training_checks import begun_run

from gsdmsr_cli.commands._beginning import resumed_options
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training.request import Request


@pytest.fixture
def run(tiny_scene: Path, tmp_path: Path) -> Run:
    options = "training.views_per_step=8", "splats.count=20", "splats.start=box"
    return begun_run(tiny_scene, tmp_path / "run", options)


def asked(run: Run, *overrides: str) -> Request:
    return Request(run.data, run.root, resume=True, overrides=overrides)


def test_the_views_of_a_step_and_the_length_may_change(run: Run) -> None:
    """A GPU that is full has no memory for as many; a CPU has other views where null says so."""
    assert resumed_options(run, asked(run)) == run.preset
    changed = resumed_options(run, asked(run, "training.views_per_step=2", "training.steps=7"))
    assert changed.training.views_per_step == 2 and changed.training.steps == 7
    assert resumed_options(run, asked(run, "training.views_per_step=null")).training.views_on("cpu")


def test_what_changes_the_model_may_not(run: Run) -> None:
    with pytest.raises(UsageError, match=r"with splats\.count = 20, not 21"):
        resumed_options(run, asked(run, "splats.count=21"))
