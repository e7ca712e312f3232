"""The training loop: steps until the clock has run out, with reports and checkpoints."""

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
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.ground.progress import time_left
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.keeping import Keeper
from gsdmsr_cli.training.trainer import Trainer

REPORT_EVERY = 2.0
"""Longest time between two reports [s]."""

REPORT_EVERY_PROGRESS = 0.02
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
        salient: share of them that the optimiser updates in full; 1 without a gate.
        still: share of them that stand still.
        dropped: splats dropped since the training began, because values were not finite.
        ms_per_step: mean wall time since the last report [ms].
        psnr: of the watched view, rounded to 8 bits [dB], or None if it is not a number.
        split: which split that view belongs to, "val" or, in scenes without, "train".
        timings: seconds since the last report by what they went into, see ``TIMINGS``.
        power: of the share of the time that progress is, see ``schedule.Clock``.
    """

    step: int
    elapsed: float
    progress: float
    loss: float | None
    splats: int
    salient: float
    still: float
    dropped: int
    ms_per_step: float
    psnr: float | None
    split: str
    timings: Mapping[str, float]
    power: float = 1.0

    @property
    def remaining(self) -> float:
        """Wall time that is left at the pace so far [s]."""
        return time_left(self.elapsed, self.progress, self.power)

    @property
    def place(self) -> str:
        """Where in the training it is, beside step and progress; empty where there is no more."""
        return ""

    @property
    def always_told(self) -> bool:
        """Whether it is a line of its own even where there are only lines now and then."""
        return False

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
            "dropped": self.dropped,
            "ms_per_step": round(self.ms_per_step, 3),
            f"{self.split}_psnr": self.psnr,
            "timings": {name: round(seconds, 4) for name, seconds in self.timings.items()},
        }


def train(
    trainer: Trainer,
    run: Run,
    on_report: Callable[[Report], None],
    on_warning: Callable[[str], None] = lambda text: None,
) -> bool:
    """Train to the end of the clock; return False if Ctrl-C ended it earlier.

    Every report goes to the run's log and to ``on_report``. Checkpoints are saved at the preset's
    interval and at either end, whatever ends the training. Reports and checkpoints count as time of
    training. What cannot be written for a while is told to ``on_warning``.

    Raises:
        GsdmsrError: the training has diverged; the last checkpoint is kept.
        DataError: a picture cannot be read, or the last checkpoint not be written.
    """

    def work(keeper: Keeper, wanted: threading.Event) -> None:
        interval = Interval(trainer, validation_view(trainer.scene), REPORT_EVERY_PROGRESS)
        trainer.clock.start()
        make_steps(interval, keeper, on_report, wanted)
        if interval.losses:
            tell(interval.report(), keeper, on_report)

    return kept_while(work, Keeper(trainer, run, on_warning), trainer.ranks.size > 1)


def kept_while(
    work: Callable[[Keeper, threading.Event], None], keeper: Keeper, patient: bool = False
) -> bool:
    """Work with Ctrl-C as an event, and save at the end, whatever that is; return if it was whole.

    Args:
        work: is told when the end is wanted.
        keeper: saves.
        patient: whether a second Ctrl-C waits as well.

    Raises:
        GsdmsrError, DataError: see ``train``.
    """
    with _ctrl_c(patient) as wanted:
        try:
            work(keeper, wanted)
        except KeyboardInterrupt:  # the second Ctrl-C, which does not wait
            raise
        except BaseException:
            keeper.rescue()
            raise
        keeper.finish()
    return not wanted.is_set()


def tell(report: Report, keeper: Keeper, on_report: Callable[[Report], None]) -> None:
    """Log a report, and hand it on."""
    keeper.log(report.entry())
    on_report(report)


def make_steps(
    interval: Interval,
    keeper: Keeper,
    on_report: Callable[[Report], None],
    wanted: threading.Event,
) -> None:
    """Make steps until the clock has run out or the end is wanted, with reports and checkpoints."""
    trainer = interval.trainer
    save_every = 60 * trainer.preset.training.checkpoint_minutes
    interval.begin()
    saved = time.perf_counter()
    while _goes_on(trainer, wanted):
        interval.count(trainer.step().loss)
        if interval.is_due():
            tell(interval.report(), keeper, on_report)
        if time.perf_counter() - saved >= save_every:
            with trainer.stopwatch.of("save"):
                keeper.save()
            saved = time.perf_counter()


def follow(trainer: Trainer) -> bool:
    """Make the steps of a training that the first rank keeps; return False if they ended early.

    Raises:
        GsdmsrError: the training has diverged, or the connection to another rank is lost.
        DataError: a picture cannot be read.
    """
    with _ctrl_c(patient=True) as wanted:
        trainer.clock.start()
        while _goes_on(trainer, wanted):
            trainer.step()
    return not wanted.is_set()


def _goes_on(trainer: Trainer, wanted: threading.Event) -> bool:
    """Return whether there is another step to make; the end that any rank wants is wanted."""
    if trainer.meet(wanted.is_set()):
        wanted.set()
        return False
    # A signal may have come since, of which the others do not know: they make the step.
    return trainer.clock.progress < 1


def validation_view(scene: Scene) -> View:
    """Return the view whose PSNR is reported: the middle one of val, or of train without a val."""
    views = [view for view in scene.views if view.split == "val"] or scene.split("train")
    return views[len(views) // 2]


@dataclass
class Interval:
    """The steps since the last report.

    Attributes:
        trainer: that makes them.
        view: whose PSNR is told.
        every: progress after which a report is due, if it is not for the time.
        losses: of the steps.
        elapsed, progress: of the clock as the interval began.
    """

    trainer: Trainer
    view: View
    every: float
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
        """Return whether it is time for a report."""
        clock = self.trainer.clock
        return (
            clock.elapsed - self.elapsed >= REPORT_EVERY
            or clock.progress - self.progress >= self.every
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
            self.trainer.population.drop_not_finite()
        finite = [loss for loss in losses if math.isfinite(loss)]
        report = Report(
            step=clock.step,
            elapsed=clock.elapsed,
            progress=clock.overall,
            loss=sum(finite) / len(finite) if finite else None,
            splats=len(model.splats),
            salient=_share(self.trainer.saliency.high),
            still=1 - model.moving / len(model.splats),
            dropped=self.trainer.population.dropped,
            ms_per_step=1000 * (clock.elapsed - self.elapsed) / len(self.losses),
            psnr=self._psnr(),
            split=self.view.split,
            timings=self.trainer.stopwatch.take(),
            power=clock.power,
        )
        self.begin()
        return report

    def _psnr(self) -> float | None:
        training, model = self.trainer.renderer, self.trainer.result()
        renderer = ViewRenderer(model, training.engine, training.pictures, training.background)
        with self.trainer.stopwatch.of("validation"):
            value = psnr(quantize(renderer.draw(self.view)), renderer.true(self.view))
        return None if math.isnan(value) else min(value, PSNR_CAP)


def _share(rows: Tensor) -> float:
    return float(rows.double().mean())


@contextmanager
def _ctrl_c(patient: bool) -> Iterator[threading.Event]:
    """Turn Ctrl-C into an event, so that a step is finished; a second Ctrl-C does interrupt.

    It does not where one is ``patient``, as ranks are: torchrun signals twice, and kills later. Its
    second signal can come after the last step, and would take from the process what it tells then;
    so a patient one that was signalled stays so.
    """
    wanted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield wanted  # only the main thread may handle signals
        return

    def want(number: int, frame: FrameType | None) -> None:
        wanted.set()
        if not patient:
            signal.signal(signal.SIGINT, earlier)

    earlier = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, want)
    try:
        yield wanted
    finally:
        if not (patient and wanted.is_set()):
            signal.signal(signal.SIGINT, earlier)
