"""gsdmsr train: reconstructs a moving scene from its pictures."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cpu.jit import set_threads, threads
from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.commands._beginning import Anew, Beginning, Resumed
from gsdmsr_cli.commands._observers import OnReport, Wanted, find_observers, observing
from gsdmsr_cli.commands._plan import say_plan
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._training_display import TrainingDisplay
from gsdmsr_cli.commands._viewed import viewed
from gsdmsr_cli.formats import needs_preparing, read_scene
from gsdmsr_cli.ground import limits, machine, say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import write_json
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer
from gsdmsr_cli.options.preset import BACKGROUNDS, Preset
from gsdmsr_cli.runs.checkpoints import SCHEMA
from gsdmsr_cli.runs.run import Run, require_apart
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training import memory
from gsdmsr_cli.training.gradients.workers import processes_for
from gsdmsr_cli.training.loop import Report, train
from gsdmsr_cli.training.masks import check_masks
from gsdmsr_cli.training.request import Request
from gsdmsr_cli.training.trainer import Trainer
from gsdmsr_cli.training.warm_up import warm_up, warm_up_motion


def run(request: Request) -> None:
    """Train a scene and write a run folder, or say what would be done.

    Raises:
        UsageError: an option does not exist, cannot be changed when resuming, or needs a GPU.
        DataError: the data or the run folder cannot be used.
        KeyboardInterrupt: Ctrl-C ended the training; its folder holds a checkpoint to go on from.
    """
    observers = find_observers(request.tensorboard, request.wandb)
    with ExitStack() as held:  # folders, from before they are read until all is written there
        there = request.out.is_dir()
        if there:
            held.enter_context(sole_writer(request.out))
        beginning = Resumed(request, held) if request.resume else Anew(request, held)
        device = raster.pick_device(request.device)
        _require_precision(beginning.options, request.device, device)
        held.enter_context(one_of_readers(request.data))
        scene, load_s = _timed(lambda: _read(request))
        beginning.suit(scene)
        trainer, prepare_s = _timed(lambda: _prepare(scene, beginning.options, device))
        for text in trainer.notes:
            say.note(text)
        if request.dry_run:
            require_apart(request.out, scene)
            beginning.restore(trainer)
            say_plan(trainer, beginning.name, beginning.reason, device)
            return
        if not there:
            held.enter_context(sole_writer(request.out))  # bad data has left no empty folder
        _train(trainer, beginning, observers, request, device, load_s + prepare_s)


def _train(
    trainer: Trainer,
    beginning: Beginning,
    observers: Wanted,
    request: Request,
    device: str,
    load_s: float,
) -> None:
    with trainer:
        beginning.restore(trainer)
        folder = beginning.open_folder(trainer)
        trainer.renderer.cache_in(folder.root)
        timings = {"load_s": load_s, "compile_s": _start_work(trainer, device)}
        processes, began = len(trainer.workers), trainer.clock.step
        with (
            TrainingDisplay() as display,
            observing(observers, folder, began) as hand_on,
            viewed(folder, trainer, request.view_port) as offer,
        ):
            finished = train(trainer, folder, _all(display.show, hand_on, offer), say.warn)
    account = _write_account(folder, trainer, device, timings, processes)
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


def _read(request: Request) -> Scene:
    if request.dry_run and needs_preparing(request.data):
        raise DataError(f"{request.data}: its videos must be decoded, and a dry run writes nothing")
    with progress_bar("decoding videos") as on_progress:
        return read_scene(request.data, on_progress)


def _prepare(scene: Scene, options: Preset, device: str) -> Trainer:
    """Return a training that has read its pictures."""
    set_threads(options.training.threads)
    torch.set_num_threads(1)  # what torch itself computes in a step is too little to share
    _warn_of_memory(scene, options, device)
    pictures = Pictures(
        BACKGROUNDS[options.data.background], options.data.downscale, options.data.cache_mib << 20
    )
    _preload(pictures, scene)
    doubt = check_masks(pictures, scene.split("train"))
    if doubt is not None:
        say.warn(doubt)
    return Trainer(scene, options, raster.best_engine(device), pictures, device)


def _start_work(trainer: Trainer, device: str) -> float:
    """Make all processes of a training ready for its first step; return how long that took [s]."""

    given = trainer.scene, trainer.preset, trainer.renderer.engine

    def prepare_worker() -> None:
        warm_up_motion(*given)
        warm_up(*given)

    started = time.perf_counter()
    if device == "cpu":
        trainer.start_workers(prepare_worker)
    warm_up(*given, device)
    trainer.workers.wait()
    return time.perf_counter() - started


def _preload(pictures: Pictures, scene: Scene) -> None:
    with progress_bar("reading pictures") as on_progress:
        pictures.preload(scene.split("train"), on_progress)


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started


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
        "progress": clock.progress,
        "splats": len(trainer.model.splats),
        "peak_rss_mib": machine.peak_rss_mib(processes - 1),
        "device": device,
        "processor": machine.cpu_name(),
        **availability.usage(device),
        "threads": threads(),
        "processes": processes,
        "versions": machine.versions(),
    }
    write_json(folder.training_path, account)
    return account


def _warn_of_memory(scene: Scene, options: Preset, device: str) -> None:
    """Say so if the training may take more memory than there is."""
    processes = processes_for(options.training.views_per_step) if device == "cpu" else 1
    expected = memory.estimate(scene.split("train"), options, processes)
    text = memory.warning(expected, limits.available_memory())
    if text is not None:
        say.warn(text)


def _say_end(folder: Run, trainer: Trainer, data: Path, finished: bool) -> None:
    steps, seconds, splats = trainer.clock.step, trainer.clock.elapsed, len(trainer.model.splats)
    text = f"trained {steps} steps in {seconds:.0f} s to {splats} splats: {folder.root}"
    if not finished:
        again = ("gsdmsr", "train", "--data", str(data), "--out", str(folder.root), "--resume")
        text = f"interrupted at step {steps}; continue with: {shlex.join(again)}"
    say.note(text)
