"""gsdmsr train in a process of its own: what ends it, what does not, and what is left then."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from sinks import SINKS, sink
from training_checks import OPTIONS, STEPS

from gsdmsr_cli.runs.run import open_run

LINE = ["--preset=dnerf", "--set=motion={name: static}", *(f"--set={text}" for text in OPTIONS)]


def train(
    data: Path, run: Path, *options: str, err: int = subprocess.PIPE
) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-m", "gsdmsr_cli", "train", "--data", str(data), "--out", str(run)]
    return subprocess.run([*command, *options], stderr=err, timeout=600, check=False)


@pytest.mark.parametrize("lost", SINKS)
def test_a_log_that_nobody_gets_does_not_end_a_training(
    tiny_scene: Path, tmp_path: Path, lost: str
) -> None:
    with sink(lost) as err:
        ended = train(tiny_scene, tmp_path / "run", *LINE, err=err)
    assert ended.returncode == 0
    run = open_run(tmp_path / "run")
    assert run.load().step == STEPS == run.read_log()[-1]["step"]
    assert run.training_path.is_file()
