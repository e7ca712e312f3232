"""Two commands on one folder: one is refused with a sentence, or both have read one state."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from training_checks import begun_run

from gsdmsr_cli.commands import render as render_command
from gsdmsr_cli.commands import train as train_command
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs import run as runs
from gsdmsr_cli.runs.run import Run, open_run, open_with_model

FEW = ("splats.count=50", "splats.start=box", "motion={name: static}", "training.views_per_step=1")
Gsdmsr = Callable[..., int]

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")


@pytest.fixture(scope="module")
def trained(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has made no step."""
    return begun_run(tiny_scene, tmp_path_factory.mktemp("once") / "run", FEW).root


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Run:
    return open_run(Path(shutil.copytree(trained, tmp_path / "run")))


FILM = "--path", "orbit", "--frames", "2", "--video", "none"


@pytest.mark.parametrize(
    ("line", "written"),
    [
        (("eval",), "eval"),
        (("render", *FILM), "render/orbit"),
        (("export", "--format", "ply-sequence", "--frames", "2", "--out"), "plys"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_a_folder_that_another_writes_to_is_left_alone(
    gsdmsr: Gsdmsr, run: Run, capsys: Any, line: tuple[str, ...], written: str
) -> None:
    folder = run.root / written
    words = [line[0], run.root, *line[1:], *([folder] if line[-1] == "--out" else [])]
    with sole_writer(folder):
        assert gsdmsr(*words) == 3
        assert not any(folder.iterdir())
    assert f"{folder}: another process is writing there" in capsys.readouterr().err
    assert gsdmsr(*words) == 0 and any(folder.iterdir())


@pytest.mark.parametrize("command", ["eval", "render", "train"])
def test_data_that_is_being_replaced_is_not_read(
    gsdmsr: Gsdmsr, run: Run, tmp_path: Path, capsys: Any, command: str
) -> None:
    words = [command, *([] if command == "train" else [run.root])]
    if command == "train":
        words += ["--data", run.data, "--out", tmp_path / "new"]
    with sole_writer(run.data):
        assert gsdmsr(*words) == 3
    assert f"{run.data}: another process is writing there; wait" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", ["eval", "render", "train"])
def test_data_is_kept_while_it_is_read(
    gsdmsr: Gsdmsr, run: Run, tmp_path: Path, monkeypatch: Any, command: str
) -> None:
    held = list[str]()

    def end(*_: Any, **__: Any) -> None:
        if command == "render":
            with pytest.raises(DataError), sole_writer(run.root / "render"):
                pass
        with pytest.raises(DataError, match="another process is reading"), sole_writer(run.data):
            pass
        held.append(command)
        raise DataError("enough")

    words = [command, *([] if command == "train" else [run.root])]
    if command == "train":
        words += ["--data", run.data, "--out", tmp_path / "new"]
    monkeypatch.setattr("gsdmsr_cli.commands.eval.measure", end)
    monkeypatch.setattr(render_command, "draw_film", end)
    monkeypatch.setattr(train_command, "prepare", end)
    assert gsdmsr(*words) == 3 and held == [command]


@pytest.mark.parametrize("name", ["eval", "render"])
def test_a_run_whose_reports_or_films_are_being_written_is_not_replaced(
    gsdmsr: Gsdmsr, run: Run, capsys: Any, name: str
) -> None:
    before = run.checkpoint_path.read_bytes()
    (run.root / name).mkdir()
    holds = sole_writer if name == "eval" else one_of_readers
    with holds(run.root / name):
        words = "train", "--data", run.data, "--out", run.root, "--overwrite", "--steps", 1
        assert gsdmsr(*words) == 3
    assert f"{run.root / name}: another process is" in capsys.readouterr().err
    assert run.checkpoint_path.read_bytes() == before and (run.root / name).is_dir()


def save_another(run: Run) -> str:
    """Save a checkpoint of another step; return its hash."""
    run.save(replace(run.load(), step=99))
    return hashlib.sha256(run.checkpoint_path.read_bytes()).hexdigest()


def test_the_note_of_a_film_names_the_checkpoint_that_was_drawn(
    gsdmsr: Gsdmsr, run: Run, monkeypatch: Any
) -> None:
    """Also where the training saves another one while it is drawn."""
    drawn, real = hashlib.sha256(run.checkpoint_path.read_bytes()).hexdigest(), runs.load_model

    def load_and_go_on(*given: Any) -> Any:
        model = real(*given)
        monkeypatch.setattr(runs, "load_model", real)
        assert save_another(run) != drawn
        return model

    monkeypatch.setattr(runs, "load_model", load_and_go_on)
    assert gsdmsr("render", run.root, *FILM) == 0
    note = json.loads((run.root / "render" / "orbit.film.json").read_text())
    assert note["checkpoint_sha256"] == drawn


def test_figures_name_the_checkpoint_that_was_measured(
    gsdmsr: Gsdmsr, run: Run, monkeypatch: Any
) -> None:
    measured = hashlib.sha256(run.checkpoint_path.read_bytes()).hexdigest()
    size, real = run.checkpoint_path.stat().st_size, runs.load_model

    def load_and_go_on(*given: Any) -> Any:
        model = real(*given)
        monkeypatch.setattr(runs, "load_model", real)
        run.save(replace(run.load(), step=99, state={"long": "x" * 1000}))
        return model

    monkeypatch.setattr(runs, "load_model", load_and_go_on)
    assert gsdmsr("eval", run.root) == 0
    document = json.loads((run.root / "eval" / "metrics.json").read_text())
    assert document["protocol"]["checkpoint_sha256"] == measured
    assert document["protocol"]["checkpoint_step"] == 0
    assert document["storage"]["checkpoint_bytes"] == size


def test_a_model_is_read_with_the_options_of_its_own_training(run: Run, monkeypatch: Any) -> None:
    """Another training begins between the options and the checkpoint: both are read again."""
    other, real = load_preset("dnerf", None, [*FEW, "data.background=black"]), Run.load_model
    other = replace(other, motion=load_preset("hexplane", None, []).motion)

    def begin_another(self: Run) -> Any:
        monkeypatch.setattr(Run, "load_model", real)
        replace(self, preset=other).describe()
        try:
            return real(self)
        finally:
            self.describe()
            replace(self, name="second").describe()

    monkeypatch.setattr(Run, "load_model", begin_another)
    found, _, checkpoint = open_with_model(run.root)
    assert found.name == "second" and checkpoint.step == 0


def test_of_two_films_of_one_name_that_are_drawn_at_once_one_is_drawn(run: Run) -> None:
    """In processes of their own; whichever comes second says so, or finds all frames there."""
    line = [sys.executable, "-m", "gsdmsr_cli", "render", str(run.root), *FILM]
    both = [subprocess.Popen(line, stderr=subprocess.PIPE, text=True) for _ in "12"]
    said = [process.communicate(timeout=120)[1] for process in both]
    codes = sorted(process.returncode for process in both)
    assert codes in ([0, 0], [0, 3])
    assert (codes == [0, 3]) == any("orbit: another process is writing there" in s for s in said)
    frames = sorted(path.name for path in (run.root / "render" / "orbit").iterdir())
    assert frames == ["0000.png", "0001.png"]
