"""Reports go to TensorBoard and Weights & Biases if asked for, and a failure there ends nothing."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.commands._observers import Wanted, find_observers, observing
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.ops.planes import CUBE
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training.loop import Report

REPORT = Report(20, 3.0, 0.5, 0.25, 600, 1.0, 0.0, 0, 16.5, 29.75, "val", {"gradients": 1.5})


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path / "run", "x", Preset(), Facts(1.3, CUBE, 10), tmp_path, "dnerf", "abc")


class Recorder:
    """What stands for both packages: remembers every call."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []
        self.failing = ""

    def __getattr__(self, name: str) -> Any:
        def record(*arguments: Any, **named: Any) -> Recorder:
            if name == self.failing:
                raise OSError("no network")
            self.calls.append((name, arguments, named))
            return self

        return record

    def named(self, name: str) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
        return [(arguments, named) for own, arguments, named in self.calls if own == name]


def test_nothing_is_imported_unasked(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("tensorboardX", "wandb"):
        monkeypatch.setitem(sys.modules, module, None)  # importing it fails
    assert find_observers(False, None) == Wanted(None, None, "")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ((True, None), r"--tensorboard needs tensorboardX.*pip install 'gsdmsr\[tensorboard\]'"),
        ((False, "p"), r"--wandb needs wandb.*pip install 'gsdmsr\[wandb\]'"),
    ],
)
def test_what_is_missing_is_told_with_what_brings_it(
    asked: tuple[bool, str | None], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("tensorboardX", "wandb"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=message):
        find_observers(*asked)


def found(monkeypatch: pytest.MonkeyPatch) -> tuple[Wanted, Recorder, Recorder]:
    board, wandb = Recorder(), Recorder()
    monkeypatch.setitem(sys.modules, "tensorboardX", board)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    return find_observers(True, "toys"), board, wandb


def test_numbers_of_reports_are_handed_on(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    wanted, board, wandb = found(monkeypatch)
    with observing(wanted, run, 0) as hand_on:
        hand_on(REPORT)
        hand_on(replace(REPORT, step=30, psnr=None, loss=None))
    scalars = {
        (arguments[0], arguments[2]): arguments[1] for arguments, _ in board.named("add_scalar")
    }
    assert scalars["val_psnr", 20] == 29.75 and scalars["timings/gradients", 20] == 1.5
    assert scalars["splats", 30] == 600 and ("val_psnr", 30) not in scalars
    (_, began), ((first,), at), _ = wandb.named("init")[0], *wandb.named("log")
    assert began["project"] == "toys" and began["name"] == "run"
    assert began["config"]["density"]["cap"] == 100000
    assert first["loss"] == 0.25 and at == {"step": 20}
    assert board.named("close") and wandb.named("finish")
    assert board.named("SummaryWriter") == [
        ((str(run.root / "tensorboard"),), {"purge_step": None})
    ]


def test_earlier_events_go_with_their_run_and_stay_when_it_goes_on(
    monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    wanted, board, _ = found(monkeypatch)
    folder = run.root / "tensorboard"
    folder.mkdir(parents=True)
    for name in ("events.out.tfevents.1.host", "notes.txt"):
        (folder / name).touch()
    with observing(wanted, run, 40):
        assert len(list(folder.iterdir())) == 2
    assert board.named("SummaryWriter")[0][1] == {"purge_step": 41}
    with observing(wanted, run, 0):
        assert [path.name for path in folder.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize("failing", ["init", "log", "finish"])
def test_a_failure_is_told_once_and_the_training_goes_on(
    failing: str, monkeypatch: pytest.MonkeyPatch, run: Run, capsys: pytest.CaptureFixture[str]
) -> None:
    wanted, board, wandb = found(monkeypatch)
    wandb.failing = failing
    with observing(wanted, run, 0) as hand_on:
        hand_on(REPORT)
        hand_on(REPORT)
    (line,) = capsys.readouterr().err.splitlines()
    assert line == ("warning: Weights & Biases is left out from here on: OSError: no network")
    assert len({arguments[2] for arguments, _ in board.named("add_scalar")}) == 1
    assert board.named("close")


def test_the_end_of_a_training_is_not_swallowed(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    wanted, board, _ = found(monkeypatch)
    with pytest.raises(KeyboardInterrupt), observing(wanted, run, 0):
        raise KeyboardInterrupt
    assert board.named("close")


@pytest.mark.skipif(
    importlib.util.find_spec("tensorboardX") is None, reason="tensorboardX is not installed"
)
def test_tensorboard_reads_what_was_written(run: Run) -> None:
    with observing(find_observers(True, None), run, 0) as hand_on:
        hand_on(REPORT)
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.record_writer import masked_crc32c  # noqa: F401  (it is the real one)

    (path,) = (run.root / "tensorboard").iterdir()
    data, found, place = path.read_bytes(), {}, 0
    while place < len(data):
        length = int.from_bytes(data[place : place + 8], "little")
        event = Event.FromString(data[place + 12 : place + 12 + length])
        for value in event.summary.value:
            found[value.tag] = (value.simple_value, event.step)
        place += length + 16
    assert found["val_psnr"] == (29.75, 20) and found["timings/gradients"] == (1.5, 20)
