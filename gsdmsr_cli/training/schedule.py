"""The progress of a training, by its steps or by its time, and schedules of it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

from gsdmsr_cli.options.durations import parse_duration
from gsdmsr_cli.options.preset import TrainingOptions
from gsdmsr_cli.options.sequences import StreamOptions


def log_linear(ends: tuple[float, float], progress: float) -> float:
    """Return the value between ``ends`` that is log-linear in progress, clamped to [0, 1]."""
    p = min(max(progress, 0.0), 1.0)
    return math.exp(math.log(ends[0]) * (1 - p) + math.log(ends[1]) * p)


@dataclass
class Clock:
    """Counts steps and the wall time of training; a budget counts time, else steps do.

    Attributes:
        steps: length of the training [steps].
        budget: length of the training [s], or None.
        power: of the share of the budget that progress is.
        step: steps made.
        before: wall time of earlier sessions [s].
        told: wall time of training by the clock of the first rank, where several processes go by
            one clock [s]; else None.
    """

    steps: int
    budget: float | None
    power: float = 1.0
    step: int = 0
    before: float = 0.0
    told: float | None = None
    _started: float | None = field(default=None, repr=False)

    def start(self) -> None:
        """Let the time of this session begin."""
        self._started = time.perf_counter()

    @property
    def elapsed(self) -> float:
        """Wall time of training, over all sessions [s]."""
        return self.now if self.told is None else self.told

    @property
    def now(self) -> float:
        """Wall time of training by this process's own clock [s]."""
        if self._started is None:
            return self.before
        return self.before + time.perf_counter() - self._started

    @property
    def progress(self) -> float:
        """How far the training is, in [0, 1]."""
        if self.budget is not None:
            return math.pow(min(self.elapsed / self.budget, 1.0), self.power)
        return min(self.step / self.steps, 1.0)

    @property
    def overall(self) -> float:
        """How far all of it is, in [0, 1]: the same, unless there are several trainings in turn."""
        return self.progress


def new_clock(options: TrainingOptions) -> Clock:
    """Return the clock of a training that has not begun."""
    return Clock(*length_of(options), options.progress_power)


def length_of(options: TrainingOptions | StreamOptions) -> tuple[int, float | None]:
    """Return the length in steps, and as wall time [s] where there is a budget."""
    return options.steps, None if options.budget is None else parse_duration(options.budget)
