"""Trainings that are killed by SIGKILL, and what counts as the same end."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from gsdmsr_cli.benchmark.kills import same, survive
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.runs.checkpoints import Checkpoint


def checkpoint() -> Checkpoint:
    tensors = {"a": torch.tensor([1.0, torch.nan]), "b": torch.zeros(2, 3, dtype=torch.int64)}
    return Checkpoint(9, 1.0, 12.5, tensors, {"queue": [1, 2]})


def test_only_the_wall_time_may_differ() -> None:
    assert same(checkpoint(), replace(checkpoint(), elapsed=99.0))
    for other in (
        replace(checkpoint(), step=8),
        replace(checkpoint(), state={"queue": [2, 1]}),
        replace(checkpoint(), tensors={"a": checkpoint().tensors["a"]}),
        replace(checkpoint(), tensors=checkpoint().tensors | {"a": torch.tensor([1.0, 0.0])}),
        replace(checkpoint(), tensors=checkpoint().tensors | {"b": torch.zeros(3, 2).long()}),
        replace(checkpoint(), tensors=checkpoint().tensors | {"a": torch.tensor([1.0, -0.0])}),
    ):
        assert not same(checkpoint(), other)


def test_killed_trainings_end_as_if_left_alone(tiny_scene: Path, tmp_path: Path) -> None:
    line = ["benchmark", "resume", tiny_scene, "--out", tmp_path, "--steps", 200, "--downscale", 1]
    command = [sys.executable, "-m", "gsdmsr_cli", *map(str, line), "--kills", "2", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    kills = json.loads(done.stdout)["kills"]
    assert [kill["identical"] for kill in kills] == [True, True]
    assert all(kill["after_s"] > 0 for kill in kills)


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    (tmp_path / "something").touch()
    with pytest.raises(DataError, match="is not empty"):
        survive([], tmp_path, 1, 0, print)
