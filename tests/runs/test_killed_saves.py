"""A run folder whose writing is killed at every call and at many bytes: old or new is whole."""

from __future__ import annotations

import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kills_in_place import at_byte, kill_everywhere, killed

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs import checkpoints
from gsdmsr_cli.runs.beginning import continue_run, create_run
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import Run, is_run, open_run
from gsdmsr_cli.scene.scene import Scene

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")

FACTS = Facts(bound=1.3, box=((-1.0, -1.1, -1.2), (1.3, 1.2, 1.1)), frames=12)
BEFORE, AFTER = 7, 8
"""Steps of the checkpoint that is there, and of the one that is being written."""


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    (tmp_path / "data").mkdir()
    nothing = np.zeros((0, 3), np.float32)
    return Scene(tmp_path / "data", "dnerf", (), nothing, nothing, None, 1.3, "f1n9er")


@pytest.fixture
def run(tmp_path: Path, scene: Scene) -> Run:
    """A run with two checkpoints and a log."""
    preset = load_preset("static", None, ["training.keep=2"])
    made = create_run(tmp_path / "run", "static", preset, FACTS, scene)
    for step in (BEFORE - 1, BEFORE):
        made.save(checkpoint_of(step))
        made.log({"step": step})
    return made


def checkpoint_of(step: int) -> Checkpoint:
    rng = torch.Generator().manual_seed(step)
    return Checkpoint(step, 0.5, 1.0, {"values": torch.randn(500, generator=rng)}, {"at": step})


def assert_sound(run: Run, steps: set[int], scene: Scene) -> None:
    """Hold a run to what the next command wants of it: a whole checkpoint, and its own files."""
    opened = open_run(run.root)
    found, damage = opened.load_whole()
    assert found.step in steps and damage is None
    assert torch.equal(found.tensors["values"], checkpoint_of(found.step).tensors["values"])
    for path in checkpoints.kept(run.root):
        assert f"step-{checkpoints.read(path)[0].step:06d}" == path.stem
    continued = continue_run(opened, opened.preset, scene)
    continued.rewind_log(found.step)
    assert [entry["step"] for entry in continued.read_log()] == [BEFORE - 1, BEFORE]
    continued.save(checkpoint_of(AFTER + 1))
    assert continued.load().step == AFTER + 1
    assert not [path for path in run.root.rglob("*") if ".part" in path.name]
    for path in (*checkpoints.kept(run.root), continued.checkpoint_path):
        path.unlink()
    for step in (BEFORE - 1, BEFORE):
        continued.save(checkpoint_of(step))


@pytest.mark.parametrize("keep", [1, 2, 3])
def test_a_save_that_is_killed_at_any_call(run: Run, scene: Scene, keep: int) -> None:
    saving = replace(run, preset=load_preset("static", None, [f"training.keep={keep}"]))
    points = kill_everywhere(
        lambda: saving.save(checkpoint_of(AFTER)),
        run.root,
        lambda: assert_sound(run, {BEFORE, AFTER}, scene),
    )
    assert points >= 10


def test_a_beginning_that_is_killed_at_any_call(run: Run, scene: Scene, tmp_path: Path) -> None:
    """Then the same command begins, unless there is a run to be gone on with already."""
    root = tmp_path / "new"

    def begin(overwrite: bool = False) -> Run:
        return create_run(root, "static", run.preset, FACTS, scene, overwrite)

    def check() -> None:
        begin(overwrite=is_run(root)).save(checkpoint_of(AFTER))
        assert not [path for path in root.rglob("*") if ".part" in path.name]
        shutil.rmtree(root)

    assert kill_everywhere(begin, root, check) >= 8


def test_a_beginning_anew_that_is_killed_at_any_call(run: Run, scene: Scene) -> None:
    """The folder stays one of a run, which the same command replaces."""

    def begin() -> Run:
        made = create_run(run.root, "static", run.preset, FACTS, scene, overwrite=True)
        made.save(checkpoint_of(AFTER))
        return made

    def check() -> None:
        assert begin().load().step == AFTER
        assert not [path for path in run.root.rglob("*") if ".part" in path.name]
        for step in (BEFORE - 1, BEFORE):
            run.save(checkpoint_of(step))
            run.log({"step": step})

    assert kill_everywhere(begin, run.root, check) >= 20


def test_a_resume_that_is_killed_at_any_call(run: Run, scene: Scene) -> None:
    def resume() -> None:
        continue_run(run, run.preset, scene).rewind_log(BEFORE)

    points = kill_everywhere(resume, run.root, lambda: assert_sound(run, {BEFORE}, scene))
    assert points >= 6


@pytest.mark.parametrize("fatal", [True, False], ids=["killed", "full disk"])
def test_a_save_that_ends_at_any_byte(run: Run, scene: Scene, fatal: bool) -> None:
    size = run.checkpoint_path.stat().st_size
    for number in (*range(0, size, size // 30), size - 1):

        def save() -> None:
            try:
                run.save(checkpoint_of(AFTER))
            except DataError as error:
                assert "cannot be written" in str(error)
                os.kill(os.getpid(), signal.SIGTERM)

        assert killed(save, at_byte(number, fatal))
        assert_sound(run, {BEFORE}, scene)


@pytest.mark.parametrize("fatal", [True, False], ids=["killed", "full disk"])
def test_a_line_of_the_log_that_ends_at_any_byte(run: Run, scene: Scene, fatal: bool) -> None:
    size = run.log_path.stat().st_size
    for number in range(size, size + 12):
        killed(lambda: run.log({"step": AFTER}), at_byte(number, fatal))
        assert [entry["step"] for entry in run.read_log()] == [BEFORE - 1, BEFORE]
        run.rewind_log(BEFORE)
    assert_sound(run, {BEFORE}, scene)
