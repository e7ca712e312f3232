"""The loop: what is reported and logged, when checkpoints are saved, and how Ctrl-C ends it."""

from __future__ import annotations

import json
import math
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from training_checks import (
    STEPS,
    assert_same_tensors,
    copies,
    preset_of,
    run_of,
    trainer_of,
)

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.evaluation.metrics import psnr, quantize
from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.runs import checkpoints, log
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training import keeping, loop
from gsdmsr_cli.training.loop import Report, _goes_on, train, validation_view
from gsdmsr_cli.training.trainer import Step, Trainer


def log_of(run: Run) -> list[dict[str, Any]]:
    return [json.loads(line) for line in run.log_path.read_text().splitlines()]


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of(motion="static"))


@pytest.fixture
def run(trainer: Trainer, tmp_path: Path) -> Run:
    return run_of(trainer, tmp_path / "run")


@pytest.fixture
def saves(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The step of every checkpoint that is saved."""
    steps: list[int] = []
    save = Run.save

    def counting(self: Run, checkpoint: Checkpoint) -> None:
        steps.append(checkpoint.step)
        save(self, checkpoint)

    monkeypatch.setattr(Run, "save", counting)
    return steps


@pytest.fixture
def interrupts() -> Any:
    """Whoever gets Ctrl-C outside of the loop; put back afterwards."""
    caught: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: caught.append(number))
    yield caught
    signal.signal(signal.SIGINT, before)


def test_it_trains_to_the_end_and_saves_the_result(
    trainer: Trainer, run: Run, saves: list[int]
) -> None:
    reports: list[Report] = []
    assert train(trainer, run, reports.append) is True
    assert trainer.clock.step == STEPS == reports[-1].step and reports[-1].progress == 1
    assert saves == [STEPS]
    checkpoint = run.load()
    assert (checkpoint.step, checkpoint.progress) == (STEPS, 1.0)
    assert 0 < checkpoint.elapsed <= trainer.clock.elapsed
    model, _ = run.load_model()
    assert_same_tensors(copies(model.tensors()), copies(trainer.model.tensors()))


def test_every_report_is_passed_on_and_logged(trainer: Trainer, run: Run) -> None:
    reports: list[Report] = []
    losses: list[float] = []
    step = trainer.step

    def remember() -> Step:
        made = step()
        losses.append(made.loss.item())
        return made

    trainer.step = remember  # type: ignore[method-assign]
    train(trainer, run, reports.append)
    log = log_of(run)
    assert log == [report.entry() for report in reports]
    assert len(reports) == STEPS  # each step is more than 2 % of this training
    assert [entry["step"] for entry in log] == list(range(1, STEPS + 1))
    assert [entry["loss"] for entry in log] == losses
    assert all(a["elapsed"] <= b["elapsed"] for a, b in pairwise(log))
    assert log[-1]["splats"] == len(trainer.model.splats)
    assert {entry["dropped"] for entry in log} == {0}
    assert all(entry["ms_per_step"] > 0 and entry["val_psnr"] > 0 for entry in log)


def test_a_report_sums_up_the_steps_since_the_last(
    trainer: Trainer, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "REPORT_EVERY_PROGRESS", 0.35)
    losses = iter([1.0, 2.0, math.nan, 6.0] + [math.nan] * 10 + [5.0] * 12)

    def step() -> Step:
        trainer.clock.step += 1
        return Step(torch.tensor(next(losses)))

    trainer.step = step  # type: ignore[method-assign]
    trainer.clock.steps = 26
    train(trainer, run, lambda report: None)
    log = log_of(run)
    assert [entry["step"] for entry in log] == [10, 20, 26]
    assert [entry["loss"] for entry in log] == [3.0, 5.0, 5.0]


def test_without_a_finite_loss_the_report_has_none(trainer: Trainer, run: Run) -> None:
    def step() -> Step:
        trainer.clock.step += 1
        return Step(torch.tensor(math.nan))

    trainer.step = step  # type: ignore[method-assign]
    train(trainer, run, lambda report: None)
    assert {entry["loss"] for entry in log_of(run)} == {None}


def test_the_psnr_is_of_the_middle_view_of_val(trainer: Trainer, run: Run) -> None:
    reports: list[Report] = []
    train(trainer, run, reports.append)
    view = trainer.scene.split("val")[1]
    assert validation_view(trainer.scene) is view
    with torch.no_grad():
        camera = trainer.renderer.pictures.camera(view)
        frame = draw(
            trainer.model, camera, view.time, trainer.renderer.engine, trainer.renderer.background
        )
    true = trainer.renderer.pictures.load(view).permute(1, 2, 0) / 255
    assert reports[-1].psnr == pytest.approx(psnr(quantize(frame.rgb), true))
    assert reports[-1].psnr != reports[0].psnr


def test_without_val_a_train_view_is_drawn(trainer: Trainer, run: Run) -> None:
    views = tuple(view for view in trainer.scene.views if view.split != "val")
    trainer.scene = replace(trainer.scene, views=views)
    train(trainer, run, lambda report: None)
    assert validation_view(trainer.scene) is trainer.scene.split("train")[6]
    assert all("train_psnr" in entry and "val_psnr" not in entry for entry in log_of(run))


def test_a_model_that_is_not_a_number_has_no_psnr(trainer: Trainer, run: Run) -> None:
    def step() -> Step:
        trainer.clock.step += 1
        trainer.renderer.background = torch.full((3,), math.nan)
        return Step(torch.tensor(1.0))

    trainer.step = step  # type: ignore[method-assign]
    train(trainer, run, lambda report: None)
    assert {entry["val_psnr"] for entry in log_of(run)} == {None}


def test_checkpoints_are_saved_at_intervals(
    tiny_scene: Path, tmp_path: Path, saves: list[int]
) -> None:
    preset = preset_of("training.checkpoint_minutes=1e-9", motion="static")
    trainer = trainer_of(tiny_scene, preset)
    train(trainer, run_of(trainer, tmp_path / "run"), lambda report: None)
    assert saves == [*range(1, STEPS + 1), STEPS]


def test_a_training_ends_with_its_budget(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = trainer_of(
        tiny_scene, preset_of("training.budget=0.5s", "training.steps=10000", motion="static")
    )
    reports: list[Report] = []
    assert train(trainer, run_of(trainer, tmp_path / "run"), reports.append)
    assert trainer.clock.progress == 1 and 0.5 <= trainer.clock.elapsed < 30
    assert 1 < reports[-1].step <= trainer.clock.step < 10_000  # which is where steps would end it


def test_ctrl_c_ends_after_the_step_and_saves(
    trainer: Trainer, run: Run, saves: list[int], interrupts: list[int]
) -> None:
    def press(report: Report) -> None:
        if report.step == 5:
            signal.raise_signal(signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    assert train(trainer, run, press) is False
    assert trainer.clock.step == 5 and saves == [5] and interrupts == []
    assert run.load().step == 5
    assert signal.getsignal(signal.SIGINT) is handler


def test_ctrl_c_in_a_step_does_not_cut_it(
    trainer: Trainer, run: Run, interrupts: list[int]
) -> None:
    step = trainer.step

    def pressed() -> Step:
        if trainer.clock.step == 2:
            signal.raise_signal(signal.SIGINT)
        return step()

    trainer.step = pressed  # type: ignore[method-assign]
    assert train(trainer, run, lambda report: None) is False
    assert run.load().step == 3 and log_of(run)[-1]["step"] == 3 and interrupts == []


def test_a_second_ctrl_c_goes_where_it_went_before(
    trainer: Trainer, run: Run, interrupts: list[int]
) -> None:
    def press_twice(report: Report) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    assert train(trainer, run, press_twice) is False
    assert interrupts == [signal.SIGINT]


def test_ctrl_c_is_left_alone_outside_of_the_main_thread(trainer: Trainer, run: Run) -> None:
    ended: list[bool] = []
    thread = threading.Thread(target=lambda: ended.append(train(trainer, run, lambda report: None)))
    thread.start()
    thread.join(60)
    assert ended == [True]


@pytest.mark.parametrize("error", [GsdmsrError("diverged"), DataError("a.png: truncated")])
def test_an_error_leaves_the_last_checkpoint(
    tiny_scene: Path, tmp_path: Path, interrupts: list[int], error: GsdmsrError
) -> None:
    preset = preset_of("training.checkpoint_minutes=1e-9", motion="static")
    trainer = trainer_of(tiny_scene, preset)
    run, step = run_of(trainer, tmp_path / "run"), trainer.step

    def fails() -> Step:
        if trainer.clock.step == 4:
            raise error
        return step()

    trainer.step = fails  # type: ignore[method-assign]
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(type(error)):
        train(trainer, run, lambda report: None)
    assert run.load().step == 4
    assert signal.getsignal(signal.SIGINT) is handler


def frequent(tiny_scene: Path, tmp_path: Path) -> tuple[Trainer, Run]:
    """A training that saves after every step, and its run folder with a first checkpoint."""
    trainer = trainer_of(tiny_scene, preset_of("training.checkpoint_minutes=1e-9", motion="static"))
    run = run_of(trainer, tmp_path / "run")
    run.save(trainer.checkpoint())
    return trainer, run


def failing(monkeypatch: Any, target: Any, name: str, fails: Callable[[int], bool]) -> list[int]:
    """Let the calls of a function of which ``fails`` is true end with a full disk; count them."""
    calls, function = [0], getattr(target, name)

    def call(*arguments: Any, **named: Any) -> Any:
        calls[0] += 1
        if fails(calls[0]):
            raise OSError(28, "No space left on device")
        return function(*arguments, **named)

    monkeypatch.setattr(target, name, call)
    return calls


def test_a_disk_that_is_full_for_a_while_does_not_end_a_training(
    tiny_scene: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    trainer, run = frequent(tiny_scene, tmp_path)
    at_most: list[int] = []
    failing(monkeypatch, checkpoints, "save_file", lambda n: 5 <= n < 9 or n == 20)
    warnings: list[str] = []
    assert train(trainer, run, lambda r: at_most.append(run.load().step), warnings.append)
    # a report comes before the checkpoint of its step
    assert at_most == [*range(5), *[4] * 4, *range(9, 20), 19, *range(21, 40)]
    assert run.load().step == STEPS
    assert len(warnings) == 2  # once for each time in a row
    assert all("No space left on device" in text and "tries again" in text for text in warnings)


def test_lines_of_the_log_wait_until_they_can_be_written(
    trainer: Trainer, run: Run, monkeypatch: Any
) -> None:
    failing(monkeypatch, log.os, "fdopen", lambda n: 3 <= n < 8)
    warnings: list[str] = []
    assert train(trainer, run, lambda report: None, warnings.append)
    assert [entry["step"] for entry in log_of(run)] == list(range(1, STEPS + 1))
    assert len(warnings) == 1 and "metrics.jsonl: cannot be written" in warnings[0]


def test_the_last_checkpoint_is_tried_again(trainer: Trainer, run: Run, monkeypatch: Any) -> None:
    monkeypatch.setattr(keeping, "PAUSES", (0.0, 0.0, 0.0))
    calls = failing(monkeypatch, checkpoints, "save_file", lambda n: n < 4)
    warnings: list[str] = []
    assert train(trainer, run, lambda report: None, warnings.append)
    assert calls == [4] and run.load().step == STEPS and len(warnings) == 1


def test_a_full_disk_at_the_end_leaves_the_checkpoint_before_and_says_so(
    tiny_scene: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    trainer, run = frequent(tiny_scene, tmp_path)
    monkeypatch.setattr(keeping, "PAUSES", (0.0, 0.0, 0.0))
    failing(monkeypatch, checkpoints, "save_file", lambda n: n > 7)
    with pytest.raises(DataError, match=f"has come to step {STEPS}; the checkpoint before stays"):
        train(trainer, run, lambda report: None)
    assert run.load().step == 7


@pytest.mark.parametrize("error", [ZeroDivisionError(), SystemExit(1), MemoryError()])
def test_whatever_ends_the_loop_the_last_state_is_saved(
    trainer: Trainer, run: Run, error: BaseException
) -> None:
    def fail(report: Report) -> None:
        if report.step == 5:
            raise error

    warnings: list[str] = []
    with pytest.raises(type(error)):
        train(trainer, run, fail, warnings.append)
    assert run.load().step == 5
    assert warnings == ["an error ends the training; --resume goes on from step 5"]


def test_what_a_step_has_half_changed_is_not_saved(
    tiny_scene: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    trainer, run = frequent(tiny_scene, tmp_path)
    failing(monkeypatch, Trainer, "_apply_events", lambda n: n == 6)
    with pytest.raises(OSError, match="No space"):
        train(trainer, run, lambda report: None)
    assert run.load().step == 5


def test_a_training_goes_on_from_an_error_as_if_there_had_been_none(
    tiny_scene: Path, tmp_path: Path, monkeypatch: Any
) -> None:
    preset = preset_of("training.views_per_step=2")
    undisturbed = trainer_of(tiny_scene, preset)
    train(undisturbed, run_of(undisturbed, tmp_path / "a"), lambda report: None)
    trainer = trainer_of(tiny_scene, preset)
    run = run_of(trainer, tmp_path / "b")
    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        failing(patch, type(trainer.workers), "gradients", lambda n: n == 23)
        train(trainer, run, lambda report: None)
    assert run.load().step == 22
    resumed = trainer_of(tiny_scene, preset)
    resumed.restore(run.load())
    train(resumed, run, lambda report: None)
    assert_same_tensors(copies(resumed.model.tensors()), copies(undisturbed.model.tensors()))


def test_time_left_follows_from_the_pace() -> None:
    report = Report(10, 30.0, 0.25, 0.1, 5, 1.0, 0.0, 0, 3.0, 20.0, "val", {})
    assert report.remaining == pytest.approx(90.0)
    assert math.isfinite(replace(report, progress=0.0).remaining)
    assert replace(report, progress=1.0).remaining == 0


def test_a_signal_of_which_other_ranks_do_not_know_yet_ends_no_step() -> None:
    """It comes while they meet, after this one has said that it wants no end."""
    wanted, said = threading.Event(), list[bool]()

    def meet(end_wanted: bool) -> bool:
        said.append(end_wanted)
        wanted.set()
        return end_wanted

    trainer: Any = SimpleNamespace(meet=meet, clock=SimpleNamespace(progress=0.5))
    assert [_goes_on(trainer, wanted) for _ in "12"] == [True, False]
    assert said == [False, True]
