"""What a training does before its first step: it reads the data and compiles the kernels."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

import torch

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cpu.jit import set_threads
from gsdmsr_cli.commands._party import Party
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.formats import needs_preparing, read_scene
from gsdmsr_cli.ground import limits, say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.options.preset import BACKGROUNDS, Preset
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training import memory
from gsdmsr_cli.training.gradients.workers import processes_for
from gsdmsr_cli.training.masks import check_masks
from gsdmsr_cli.training.ranks.alone import most_of
from gsdmsr_cli.training.request import Request
from gsdmsr_cli.training.streaming.shots import first_shot
from gsdmsr_cli.training.streaming.trainer import StreamTrainer
from gsdmsr_cli.training.trainer import Trainer
from gsdmsr_cli.training.warm_up import warm_up, warm_up_motion

T = TypeVar("T")


def read(request: Request) -> Scene:
    """Return the scene; videos are decoded where that has not been done.

    Raises:
        DataError: it cannot be used.
    """
    if request.dry_run and needs_preparing(request.data):
        raise DataError(f"{request.data}: its videos must be decoded, and a dry run writes nothing")
    with progress_bar("decoding videos") as on_progress:
        return read_scene(request.data, on_progress)


def prepare(scene: Scene, options: Preset, party: Party, device: str) -> Trainer:
    """Return a training that has read its pictures.

    Raises:
        DataError: a picture cannot be read.
    """
    set_threads(party.threads(options.training))
    torch.set_num_threads(1)  # what torch itself computes in a step is too little to share
    _warn_of_memory(scene, options, party, device)
    pictures = Pictures(
        BACKGROUNDS[options.data.background], options.data.downscale, options.data.cache_mib << 20
    )
    streams = options.stream.enabled
    _preload(pictures, first_shot(scene) if streams else scene)
    doubt = check_masks(pictures, scene.split("train"))
    if doubt is not None:
        say.warn(doubt)
    kind = StreamTrainer if streams else Trainer
    return kind(scene, options, raster.best_engine(device), pictures, device, party.ranks)


def start_work(trainer: Trainer, device: str) -> float:
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


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """Return what the work returns, and how long it took [s]."""
    started = time.perf_counter()
    result = work()
    return result, time.perf_counter() - started


def _warn_of_memory(scene: Scene, options: Preset, party: Party, device: str) -> None:
    """Say so if the training may take more memory than there is."""
    views = most_of(options.training.views_on(device), party.ranks.size)
    processes = processes_for(views) if device == "cpu" else 1
    expected = memory.estimate(scene.split("train"), options, processes)
    text = memory.warning(expected, limits.available_memory())
    if text is not None:
        say.warn(text)
