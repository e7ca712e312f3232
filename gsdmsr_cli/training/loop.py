"""The training loop: step until the clock has run out, tell and save on the way."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.evaluation.metrics import PSNR_CAP, psnr, quantize
from gsdmsr_cli.evaluation.protocol import Studio
from gsdmsr_cli.run import Run
from gsdmsr_cli.scene import Scene, View
from gsdmsr_cli.training.trainer import Trainer

TELL_EVERY = 2.0
"""Longest time between two reports [s]."""

TELL_EVERY_PROGRESS = 0.02
"""Most progress between two reports; whichever comes first."""


@dataclass(frozen=True)
class Report:
    """How the training stands.

    Attributes:
        step: steps made.
        elapsed: wall time of training [s].
        progress: in [0, 1].
        loss: mean over the steps since the last report, or None if none was finite.
        splats: number of splats.
        salient: share of them that the optimiser attends to in full; 1 without a gate.
        still: share of them that stand still.
        ms_per_step: mean wall time since the last report [ms].
        psnr: of the watched view, rounded to 8 bits [dB], or None if it is not a number.
        split: which split the watched view belongs to, "val" or, in scenes without, "train".
        stages: seconds since the last report by what they went into, see ``training.stages``.
    """

    step: int
    elapsed: float
    progress: float
    loss: float | None
    splats: int
    salient: float
    still: float
    ms_per_step: float
    psnr: float | None
    split: str
    stages: Mapping[str, float]

    @property
    def remaining(self) -> float:
        """Wall time that is left at the pace so far [s]."""
        return self.elapsed * (1 - self.progress) / max(self.progress, 1e-9)

    def entry(self) -> dict[str, Any]:
        """Return the report as a line of the log."""
        return {
            "step": self.step,
            "elapsed": round(self.elapsed, 3),
            "progress": round(self.progress, 5),
            "loss": self.loss,
            "splats": self.splats,
            "salient": round(self.salient, 4),
            "still": round(self.still, 4),
            "ms_per_step": round(self.ms_per_step, 3),
            f"{self.split}_psnr": self.psnr,
            "stages": {stage: round(seconds, 4) for stage, seconds in self.stages.items()},
        }


def train(trainer: Trainer, run: Run, tell: Callable[[Report], None]) -> bool:
    """Train to the end of the clock; return False if Ctrl-C ended it earlier.

    Every report goes to the run's log and to ``tell``. Checkpoints are saved at the preset's
    interval and at either end. Reports and checkpoints count as time of training.

    Raises:
        GsdmsrError: the training has diverged; the last checkpoint is kept.
        DataError: a picture cannot be read, or a checkpoint not be written.
    """
    watch = _Watch(trainer, watched_view(trainer.scene))
    interval = 60 * trainer.preset.training.checkpoint_minutes
    with _ctrl_c() as wanted:
        trainer.clock.start()
        watch.begin()
        saved = time.perf_counter()
        while trainer.clock.progress < 1 and not wanted.is_set():
            watch.count(trainer.step().loss)
            if watch.is_due():
                _tell(watch.report(), run, tell)
            if time.perf_counter() - saved >= interval:
                with trainer.stopwatch.of("save"):
                    run.save(trainer.checkpoint())
                saved = time.perf_counter()
        if watch.losses:
            _tell(watch.report(), run, tell)
        run.save(trainer.checkpoint())
    return not wanted.is_set()


def watched_view(scene: Scene) -> View:
    """Return the view whose PSNR is reported: the middle one of val, or of train without a val."""
    views = [view for view in scene.views if view.split == "val"] or scene.split("train")
    return views[len(views) // 2]


def _tell(report: Report, run: Run, tell: Callable[[Report], None]) -> None:
    run.log(report.entry())
    tell(report)


@dataclass
class _Watch:
    """What has happened since the last report."""

    trainer: Trainer
    view: View
    losses: list[Tensor] = field(default_factory=list)
    elapsed: float = 0.0
    progress: float = 0.0

    def begin(self) -> None:
        """Count from now on."""
        clock = self.trainer.clock
        self.losses, self.elapsed, self.progress = [], clock.elapsed, clock.progress

    def count(self, loss: Tensor) -> None:
        """Add one step."""
        self.losses.append(loss)

    def is_due(self) -> bool:
        """Tell whether it is time for a report."""
        clock = self.trainer.clock
        return (
            clock.elapsed - self.elapsed >= TELL_EVERY
            or clock.progress - self.progress >= TELL_EVERY_PROGRESS
        )

    def report(self) -> Report:
        """Return the report and begin anew; here a GPU is waited for.

        Raises:
            GsdmsrError: the training has diverged.
        """
        clock, model = self.trainer.clock, self.trainer.model
        losses = torch.stack(self.losses).tolist()
        if self.trainer.device.type != "cpu":
            self.trainer.count(losses)
        finite = [loss for loss in losses if math.isfinite(loss)]
        report = Report(
            step=clock.step,
            elapsed=clock.elapsed,
            progress=clock.progress,
            loss=sum(finite) / len(finite) if finite else None,
            splats=len(model.splats),
            salient=_share(self.trainer.saliency.high),
            still=1 - model.moving / len(model.splats),
            ms_per_step=1000 * (clock.elapsed - self.elapsed) / len(self.losses),
            psnr=self._psnr(),
            split=self.view.split,
            stages=self.trainer.stopwatch.take(),
        )
        self.begin()
        return report

    def _psnr(self) -> float | None:
        observer = self.trainer.observer
        model, background = self.trainer.result(), observer.background
        studio = Studio(model, observer.engine, observer.pictures, background)
        with self.trainer.stopwatch.of("watch"):
            value = psnr(quantize(studio.draw(self.view)), studio.true(self.view))
        return None if math.isnan(value) else min(value, PSNR_CAP)


def _share(rows: Tensor) -> float:
    return float(rows.double().mean())


@contextmanager
def _ctrl_c() -> Iterator[threading.Event]:
    """Turn Ctrl-C into an event, so that no step is cut in two; a second Ctrl-C does interrupt."""
    wanted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield wanted  # only the main thread may handle signals
        return

    def want(number: int, frame: FrameType | None) -> None:
        wanted.set()
        signal.signal(signal.SIGINT, earlier)

    earlier = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, want)
    try:
        yield wanted
    finally:
        signal.signal(signal.SIGINT, earlier)
