"""gsdmsr train: reconstructs a moving scene from its pictures."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cpu.jit import set_threads, threads
from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.commands._choice import Choice, Chosen
from gsdmsr_cli.commands._observers import OnReport, find_observers, observing
from gsdmsr_cli.commands._plan import say_plan
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._results import remove_results
from gsdmsr_cli.commands._training_display import TrainingDisplay
from gsdmsr_cli.formats import needs_preparing, read_scene
from gsdmsr_cli.ground import limits, machine, say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import write_json
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.preset import BACKGROUNDS, Preset, load_preset
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import (
    OUTPUTS,
    SCHEMA,
    Run,
    continue_run,
    create_run,
    open_run,
    refuse_used,
    require_apart,
)
from gsdmsr_cli.runs.seen_pictures import check_whole
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training import memory
from gsdmsr_cli.training.loop import Report, train
from gsdmsr_cli.training.schedule import new_clock
from gsdmsr_cli.training.trainer import Trainer
from gsdmsr_cli.training.warm_up import warm_up, warm_up_motion

MAY_CHANGE = (
    "training.budget", "training.steps", "training.threads", "training.checkpoint_minutes",
    "training.keep",
    "data.cache_mib",
)  # fmt: skip
"""Options that a resumed training may have otherwise: its length, and what changes no result."""


def run(
    data: Path,
    out: Path,
    preset: str | None,
    config: Path | None,
    overrides: Sequence[str],
    device: str,
    resume: bool,
    overwrite: bool,
    dry_run: bool = False,
    verify: bool = False,
    tensorboard: bool = False,
    wandb: str | None = None,
) -> None:
    """Train the scene in ``data`` and write the run folder ``out``.

    With ``dry_run`` only what has been read and checked until then is told, and nothing written.
    ``verify`` asks for hashes of whole pictures, which a resumed training compares. Reports are
    handed to TensorBoard, and to Weights & Biases under the project ``wandb``, where asked for.

    Raises:
        UsageError: an option does not exist, cannot be changed when resuming, or needs a GPU.
        DataError: the data or the run folder cannot be used.
        KeyboardInterrupt: Ctrl-C ended the training; ``out`` holds a checkpoint to go on from.
    """
    choice = Choice(preset, config, overrides)
    wanted = find_observers(tensorboard, wandb)
    with ExitStack() as locks:  # the run folder, from before it is read until all is written there
        there = out.is_dir()
        if there:
            locks.enter_context(sole_writer(out))
        earlier = open_run(out) if resume else None
        if earlier is None:
            options = choice.check()  # an error now rather than after the data has been read
            refuse_used(out, overwrite)
            for name in OUTPUTS:
                if (out / name).is_dir():  # which goes with the run, but not from under a writer
                    locks.enter_context(sole_writer(out / name))
        else:
            options = _resumed_options(earlier, preset, config, overrides)
            checkpoint, damage = earlier.load_whole()
            if damage:
                _warn(damage)
            _require_rest(earlier, options, checkpoint)
        where = raster.pick_device(device)
        _require_precision(options, device, where)
        locks.enter_context(one_of_readers(data))
        if dry_run and needs_preparing(data):
            raise DataError(f"{data}: its videos must be decoded, and a dry run writes nothing")
        scene, load_s = _timed(lambda: _read(data))
        if earlier is not None:
            earlier.check_scene(scene)
            if verify:
                check_whole(out, scene)
        else:
            chosen = choice.suit(scene)
            options = chosen.options
            _say_preset(chosen)
        trainer, prepare_s = _timed(lambda: _prepare(scene, options, where))
        timings = {"load_s": load_s + prepare_s}
        if dry_run:
            require_apart(out, scene)
            if earlier is not None:
                trainer.restore(checkpoint)
            name, reason = (earlier or chosen).name, (earlier or chosen).reason
            say_plan(trainer, name, reason, where)
            return
        with trainer:
            if not there:
                locks.enter_context(sole_writer(out))  # made now: bad data leaves no empty folder
            if earlier is None:
                about = chosen.name, options, trainer.facts, scene
                if overwrite:
                    remove_results(out)
                folder = create_run(out, *about, overwrite, chosen.reason, verify)
                folder.save(trainer.checkpoint())  # a full disk is an error now, not at the end
            else:
                trainer.restore(checkpoint)
                folder = continue_run(earlier, options, scene)
                folder.rewind_log(trainer.clock.step)
            timings["compile_s"] = _start_work(trainer, where)
            processes = len(trainer.workers)
            began = trainer.clock.step
            with TrainingDisplay() as display, observing(wanted, folder, began) as hand_on:
                finished = train(trainer, folder, _both(display.show, hand_on), _warn)
        account = _write_account(folder, trainer, where, timings, processes)
    _say_end(folder, trainer, data, finished)
    if not finished:
        raise KeyboardInterrupt
    say.result({"run": str(folder.root), "preset": folder.name, "reason": folder.reason, **account})


def _both(first: OnReport, second: OnReport) -> OnReport:
    def show(report: Report) -> None:
        first(report)
        second(report)

    return show


def _say_preset(chosen: Chosen) -> None:
    if chosen.reason is not None:
        say.note(f"{chosen.reason}; --preset names another")


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


def _read(data: Path) -> Scene:
    with progress_bar("decoding videos") as on_progress:
        return read_scene(data, on_progress)


def _prepare(scene: Scene, options: Preset, device: str) -> Trainer:
    """Return a training that has read its pictures."""
    set_threads(options.training.threads)
    torch.set_num_threads(1)  # what torch itself computes in a step is too little to share
    _warn_of_memory(scene, options, device)
    pictures = Pictures(
        BACKGROUNDS[options.data.background], options.data.downscale, options.data.cache_mib << 20
    )
    _preload(pictures, scene)
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


def _resumed_options(
    earlier: Run, preset: str | None, config: Path | None, overrides: Sequence[str]
) -> Preset:
    """Return the run's own options, with another length where the command line asks for one.

    Raises:
        UsageError: the command line asks for anything else.
    """
    stored = strict.dump(earlier.preset)
    if preset is None and config is None:
        own = [f"{topic}={json.dumps(value)}" for topic, value in stored.items()]
        asked = load_preset(None, None, [*own, *overrides])
    else:
        asked = load_preset(preset, config, overrides)
    earlier_values, values = _by_option(stored), _by_option(strict.dump(asked))
    for name in earlier_values | values:
        was, now = earlier_values.get(name), values.get(name)
        if was != now and name not in MAY_CHANGE:
            raise UsageError(
                f"{earlier.root}: was trained with {name} = {json.dumps(was)}, not "
                f"{json.dumps(now)}; --resume may change only the length of a training"
            )
    return asked


def _by_option(dumped: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a dumped preset as "topic.key", and lists as "topic"."""
    values: dict[str, Any] = {}
    for topic, value in dumped.items():
        if isinstance(value, dict):
            values |= {f"{topic}.{key}": own for key, own in value.items()}
        else:
            values[topic] = value
    return values


def _require_rest(earlier: Run, options: Preset, checkpoint: Checkpoint) -> None:
    clock = new_clock(options.training)
    clock.step, clock.before = checkpoint.step, checkpoint.elapsed
    if clock.progress >= 1:
        raise UsageError(
            f"{earlier.root}: is complete at step {clock.step} after {clock.elapsed:.0f} s; "
            "give it a longer --budget or more --steps"
        )


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
    processes = min(options.training.views_per_step, threads()) if device == "cpu" else 1
    expected = memory.estimate(scene.split("train"), options, processes)
    text = memory.warning(expected, limits.available_memory())
    if text is not None:
        _warn(text)


def _warn(text: str) -> None:
    say.warn(f"warning: {text}")


def _say_end(folder: Run, trainer: Trainer, data: Path, finished: bool) -> None:
    steps, seconds, splats = trainer.clock.step, trainer.clock.elapsed, len(trainer.model.splats)
    text = f"trained {steps} steps in {seconds:.0f} s to {splats} splats: {folder.root}"
    if not finished:
        again = ("gsdmsr", "train", "--data", str(data), "--out", str(folder.root), "--resume")
        text = f"interrupted at step {steps}; continue with: {shlex.join(again)}"
    say.note(text)
