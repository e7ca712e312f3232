"""The loop of a stream: one moment after the other, each of which is written as it ends."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

from gsdmsr_cli.model.layers.newcomers import OF_ALL_MOMENTS, OWN
from gsdmsr_cli.model.model import MOTION, MOVING
from gsdmsr_cli.runs import moments
from gsdmsr_cli.runs.moments import Rounding
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training.keeping import Keeper
from gsdmsr_cli.training.loop import (
    REPORT_EVERY_PROGRESS,
    Interval,
    Report,
    kept_while,
    make_steps,
    tell,
)
from gsdmsr_cli.training.streaming.clock import StreamClock
from gsdmsr_cli.training.streaming.shots import watched
from gsdmsr_cli.training.streaming.trainer import StreamTrainer


@dataclass(frozen=True)
class MomentReport(Report):
    """How the training stands in a stream.

    Attributes:
        moment: the present one, from 0.
        moments: how many there are.
        seconds: wall time of the moment so far, with its writing once that is done [s].
        bytes: of its file, or None until it is written.
    """

    moment: int = 0
    moments: int = 1
    seconds: float = 0.0
    bytes: int | None = None

    @property
    def remaining(self) -> float:
        """Wall time that is left if all further moments take as long as a whole later one [s]."""
        if self.bytes is None or not self.moment:
            return super().remaining
        return self.seconds * (self.moments - 1 - self.moment)

    @property
    def place(self) -> str:
        """The moment, and what it has taken."""
        known = "" if self.bytes is None else f" in {self.seconds:.1f} s, {self.bytes:,} bytes"
        return f"moment {self.moment + 1} of {self.moments}{known}  "

    @property
    def always_told(self) -> bool:
        """Whether the moment is over."""
        return self.bytes is not None

    def entry(self) -> dict[str, Any]:
        """Return the report as a line of the log."""
        own = {"moment": self.moment, "moment_s": round(self.seconds, 3), "bytes": self.bytes}
        return {**super().entry(), **own}


class MomentInterval(Interval):
    """The steps of a moment since the last report.

    Attributes:
        bytes: of the moment's file, once that is written.
    """

    bytes: int | None = None

    def is_due(self) -> bool:
        """Return whether it is time for a report before that of the moment's end."""
        return super().is_due() and self.trainer.clock.progress < 1

    def report(self) -> MomentReport:
        """Return the report and begin anew."""
        clock = self.trainer.clock
        assert isinstance(clock, StreamClock)
        found = super().report()
        own = {field.name: getattr(found, field.name) for field in fields(Report)}
        return MomentReport(
            **own, moment=clock.moment, moments=clock.moments, seconds=clock.spent, bytes=self.bytes
        )


def stream(
    trainer: StreamTrainer,
    run: Run,
    on_report: Callable[[Report], None],
    on_warning: Callable[[str], None] = lambda text: None,
) -> bool:
    """Train all moments that are left; return False if Ctrl-C ended it earlier.

    Whatever ends it, moments that were over are in the run folder, and a checkpoint of the one that
    was not. Raises and does all else as ``training.loop.train``.
    """

    def work(keeper: Keeper, wanted: threading.Event) -> None:
        trainer.clock.start()
        while _is_whole(trainer, run, keeper, on_report, wanted):
            if trainer.clock.moment == len(trainer.shots) - 1:
                return
            trainer.begin_next()
            with trainer.stopwatch.of("save"):
                keeper.save()

    return kept_while(work, Keeper(trainer, run, on_warning))


def _is_whole(
    trainer: StreamTrainer,
    run: Run,
    keeper: Keeper,
    on_report: Callable[[Report], None],
    wanted: threading.Event,
) -> bool:
    """Train the present moment to its end and write it; return whether it has come to that."""
    every = REPORT_EVERY_PROGRESS if trainer.clock.moment == 0 else 1.0
    interval = MomentInterval(trainer, watched(trainer.scene, trainer.shot), every)
    make_steps(interval, keeper, on_report, wanted)
    if trainer.clock.progress < 1:
        return False
    trainer.settle()
    interval.bytes = write_moment(run, trainer)
    if interval.losses:
        tell(interval.report(), keeper, on_report)
    return True


def write_moment(run: Run, trainer: StreamTrainer) -> int:
    """Write the file of the present moment, which is over; return its bytes.

    Raises:
        DataError: it cannot be written.
    """
    clock, time, options = trainer.clock, trainer.shot.time, trainer.preset.stream
    told = {"step": clock.step, "progress": clock.overall, "elapsed": clock.elapsed}
    if not clock.moment:
        model, motion = trainer.model, trainer.motion
        stay = {n: t for n, t in model.tensors().items() if not n.startswith(f"{MOTION}.")}
        stay |= {f"{MOTION}.{name}": motion.tensors()[name] for name in motion.staying}
        stay = {name: tensor for name, tensor in stay.items() if name not in OF_ALL_MOMENTS}
        if model.moving < len(model.splats):
            stay[MOVING] = trainer.checkpoint().tensors[MOVING]
        return moments.write_first(run.root, stay, len(motion.offsets), time, told)
    values = {"offsets": trainer.motion.offsets, "turns": trainer.motion.turns}
    rounding = Rounding(options.place_step, options.turn_step, options.keyframe_every)
    own = {} if trainer.newcomers is None else trainer.newcomers.newest.tensors()
    whole = {OWN + name: tensor for name, tensor in own.items()}
    return moments.write(run.root, clock.moment, time, values, rounding, told, whole)
