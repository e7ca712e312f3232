"""gsdmsr train: reconstructs a moving scene from its pictures."""

from __future__ import annotations

import shlex
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cpu.jit import threads
from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.commands._beginning import Anew, Beginning, Resumed, after_restart
from gsdmsr_cli.commands._following import follow
from gsdmsr_cli.commands._observers import OnReport, Wanted, find_observers, observing
from gsdmsr_cli.commands._party import Party, require_alone, require_suited
from gsdmsr_cli.commands._plan import say_plan
from gsdmsr_cli.commands._preparing import prepare, read, start_work, timed
from gsdmsr_cli.commands._ranks import joined
from gsdmsr_cli.commands._segments import is_cut, train_cut
from gsdmsr_cli.commands._training_display import TrainingDisplay
from gsdmsr_cli.commands._viewed import viewed
from gsdmsr_cli.ground import machine, say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.files import write_json
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.runs.beginning import require_apart
from gsdmsr_cli.runs.checkpoints import SCHEMA
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.loop import Report, train
from gsdmsr_cli.training.request import Request
from gsdmsr_cli.training.streaming.loop import stream
from gsdmsr_cli.training.streaming.shots import check_scene
from gsdmsr_cli.training.streaming.trainer import StreamTrainer
from gsdmsr_cli.training.trainer import Trainer


def run(request: Request) -> None:
    """Train a scene and write a run folder, or say what would be done.

    Raises:
        UsageError: an option does not exist, cannot be changed when resuming, or needs a GPU.
        DataError: the data or the run folder cannot be used.
        KeyboardInterrupt: Ctrl-C ended the training; its folder holds a checkpoint to go on from.
    """
    with joined() as party:
        if is_cut(request):
            require_alone(party)
            train_cut(request)
            return
        if request.jobs > 1 or request.workers is not None:
            raise UsageError("--jobs and --workers share out segments; give --segments as well")
        if party.leads:
            _lead(request, party)
        else:
            follow(request, party)


def _lead(asked: Request, party: Party) -> None:
    """Train, as the first rank if there are several."""
    with ExitStack() as held:  # folders, from before they are read until all is written there
        with party.all_or_none():
            observers = find_observers(asked.tensorboard, asked.wandb)
            request: Request | None = asked
            if party.restarts and party.job is not None:
                request = after_restart(asked, party.job)
            begun = None if request is None else _begin(request, party, held)
        if party.tell(begun is None) or request is None or begun is None:
            say.note(f"{asked.out}: torchrun has started a training again that is complete")
            return
        party.tell(begun.beginning.options)
        with party.all_or_none():
            party.require_same(begun.scene)
        with party.all_or_none():
            given = begun.scene, begun.options, party, begun.device
            trainer, prepare_s = timed(lambda: prepare(*given))
        for text in trainer.notes:
            say.note(text)
        if request.dry_run:
            _show_plan(trainer, begun, request)
            return
        if not begun.there:
            held.enter_context(sole_writer(request.out))  # bad data has left no empty folder
        _train(trainer, begun, observers, request, party, begun.load_s + prepare_s)


@dataclass(frozen=True)
class _Begun:
    """What is known of a training once its data has been read.

    Attributes:
        there: whether the run folder has been there, and is locked.
        beginning: how it begins.
        device: where it computes.
        scene: what it sees of its data.
        load_s: how long reading that took [s].
    """

    there: bool
    beginning: Beginning
    device: str
    scene: Scene
    load_s: float

    @property
    def options(self) -> Preset:
        """All options of the training."""
        return self.beginning.options


def _begin(request: Request, party: Party, held: ExitStack) -> _Begun:
    there = request.out.is_dir()
    if there:
        held.enter_context(sole_writer(request.out))
    beginning = Resumed(request, held) if request.resume else Anew(request, held)
    device = raster.pick_device(request.device)
    _require_precision(beginning.options, request.device, device)
    held.enter_context(one_of_readers(request.data))
    whole, load_s = timed(lambda: read(request))
    scene = beginning.suit(whole)
    require_suited(party, beginning.options, device)
    if beginning.options.stream.enabled:
        for text in check_scene(scene):
            say.warn(text)
    return _Begun(there, beginning, device, scene, load_s)


def _show_plan(trainer: Trainer, begun: _Begun, request: Request) -> None:
    require_apart(request.out, begun.scene)
    begun.beginning.restore(trainer)
    say_plan(trainer, begun.beginning.name, begun.beginning.reason, begun.device)


def _train(
    trainer: Trainer,
    begun: _Begun,
    observers: Wanted,
    request: Request,
    party: Party,
    load_s: float,
) -> None:
    with trainer:
        with party.all_or_none():
            begun.beginning.restore(trainer)
            folder = begun.beginning.open_folder(trainer)
            if party.job is not None:
                folder.belongs_to(party.job, trainer.clock.step if party.restarts else None)
        party.level(trainer)
        trainer.renderer.cache_in(folder.root)
        timings = {"load_s": load_s, "compile_s": start_work(trainer, begun.device)}
        processes, began = len(trainer.workers), trainer.clock.step
        with (
            TrainingDisplay() as display,
            observing(observers, folder, began) as hand_on,
            viewed(folder, trainer, request.view_port) as offer,
        ):
            given = folder, _all(display.show, hand_on, offer), say.warn
            if isinstance(trainer, StreamTrainer):
                finished = stream(trainer, *given)
            else:
                finished = train(trainer, *given)
    with party.all_or_none():
        account = _write_account(folder, trainer, begun.device, timings, processes)
    _say_end(folder, trainer, request.data, finished)
    if not finished:
        raise KeyboardInterrupt
    say.result({"run": str(folder.root), "preset": folder.name, "reason": folder.reason, **account})


def _all(*observers: OnReport) -> OnReport:
    def show(report: Report) -> None:
        for observer in observers:
            observer(report)

    return show


def _require_precision(options: Preset, wanted: str, device: str) -> None:
    """Raise UsageError if fields are to compute in what the device does not."""
    precision = options.training.precision
    if device == "cuda" or precision == "float32":
        return
    reason = "--device cpu was given"
    if wanted != "cpu":
        missing = raster.load_engine("cuda").unavailable("cuda")
        reason = f"--device {wanted} takes the CPU, since {missing}"
    raise UsageError(f"training.precision is {precision}; allowed on the CPU: float32; {reason}")


def _write_account(
    folder: Run, trainer: Trainer, device: str, timings: dict[str, float], processes: int
) -> dict[str, Any]:
    """Write, and return, what the training took, the budget's share and what lies outside it."""
    clock = trainer.clock
    account = {
        "schema": SCHEMA,
        **{name: round(seconds, 3) for name, seconds in timings.items()},
        "train_s": round(clock.elapsed, 3),
        "steps": clock.step,
        "progress": clock.overall,
        "splats": len(trainer.model.splats),
        "peak_rss_mib": machine.peak_rss_mib(processes - 1),
        "device": device,
        "processor": machine.cpu_name(),
        **availability.usage(device),
        "threads": threads(),
        "processes": processes,
        "versions": machine.versions(),
        **trainer.ranks.account(),
    }
    write_json(folder.training_path, account)
    return account


def _say_end(folder: Run, trainer: Trainer, data: Path, finished: bool) -> None:
    steps, seconds, splats = trainer.clock.step, trainer.clock.elapsed, len(trainer.model.splats)
    text = f"trained {steps} steps in {seconds:.0f} s to {splats} splats: {folder.root}"
    if not finished:
        again = ("gsdmsr", "train", "--data", str(data), "--out", str(folder.root), "--resume")
        text = f"interrupted at step {steps}; continue with: {shlex.join(again)}"
    say.note(text)
