"""Counts the steps and the time of a stream, and how far the present moment is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.training.schedule import Clock, length_of


@dataclass
class StreamClock(Clock):
    """Steps and time go on from moment to moment, progress begins anew in each.

    Attributes:
        moments: how many there are.
        moment: the present one, from 0.
        first_step: steps that had been made as it began.
        first_elapsed: wall time of training until then [s].
        first_length: of the first moment, in lengths of a later one.
        overrun: by how much the last of the later moments was longer than its steps had been given,
            since it was settled and written as well [s]. The next is given that much less, so that
            each takes its budget in all; with steps, 0.
    """

    moments: int = 1
    moment: int = 0
    first_step: int = 0
    first_elapsed: float = 0.0
    first_length: float = 1.0
    overrun: float = 0.0

    @property
    def progress(self) -> float:
        """How far the present moment is, in [0, 1]."""
        if self.budget is not None:
            return min(self.spent / self.budget, 1.0)
        return min((self.step - self.first_step) / self.steps, 1.0)

    @property
    def spent(self) -> float:
        """Wall time of the present moment so far [s]."""
        return self.elapsed - self.first_elapsed

    @property
    def overall(self) -> float:
        """How far all moments are, in [0, 1], as a share of their time or steps."""
        of_first = self.progress if self.moment == 0 else 1.0
        later = self.moment - 1 + self.progress if self.moment else 0.0
        total = self.first_length + self.moments - 1
        return min((of_first * self.first_length + later) / total, 1.0)

    def begin(self, moment: int, preset: Preset) -> None:
        """Let a moment begin now, of the length that the preset gives it."""
        if self.moment and self.budget is not None:
            self.overrun = max(self.spent - self.budget, 0.0)
        self.moment, self.first_step, self.first_elapsed = moment, self.step, self.elapsed
        self.measure(preset)

    def measure(self, preset: Preset) -> None:
        """Take the length of the present moment from the preset.

        Where of the first and the later ones one has steps and the other a time, nothing is known
        of how much longer the first is.
        """
        first, later = length_of(preset.training), length_of(preset.stream)
        self.steps, self.budget = later if self.moment else first
        if self.moment and self.budget is not None:
            self.budget -= min(self.overrun, self.budget / 2)
        if first[1] is not None and later[1] is not None:
            self.first_length = first[1] / later[1]
        elif first[1] is None and later[1] is None:
            self.first_length = first[0] / later[0]

    def state(self) -> dict[str, Any]:
        """Return what a resumed training needs beside the steps and the time.

        Where steps are counted that is the same in every training: it has no times in it.
        """
        own: dict[str, Any] = {"moment": self.moment, "first_step": self.first_step}
        if self.budget is not None:
            own |= {"first_elapsed": self.first_elapsed, "overrun": self.overrun}
        return own

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.moment, self.first_step = int(state["moment"]), int(state["first_step"])
        self.first_elapsed = float(state.get("first_elapsed", self.before))
        self.overrun = float(state.get("overrun", 0.0))
