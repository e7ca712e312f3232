"""Writes the log and the checkpoints of a training, which a full disk for a while does not end."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training.trainer import Trainer

PAUSES = 0.5, 1.0, 2.0
"""Before the last checkpoint is tried again [s]; a container may be killed 10 s after SIGTERM."""


class Keeper:
    """Keeps a training in its run folder.

    What cannot be written is told once, and is tried again with the next of its kind; lines of the
    log wait until then.
    """

    def __init__(self, trainer: Trainer, run: Run, on_warning: Callable[[str], None]) -> None:
        self._trainer, self._run, self._on_warning = trainer, run, on_warning
        self._lines: list[Mapping[str, Any]] = []
        self._told = set[str]()

    def log(self, entry: Mapping[str, Any] | None = None) -> None:
        """Append a line to the log, and those that could not be written before."""
        self._lines += [] if entry is None else [entry]
        if not self._lines:
            return
        outlook = "The training goes on; the next report tries again"
        if self._try("report", lambda: self._run.log(*self._lines), outlook):
            self._lines = []

    def save(self, outlook: str = "The training goes on; the next checkpoint tries again") -> bool:
        """Save a checkpoint, of splats with finite values alone; return whether it is written.

        Args:
            outlook: what is said of the time after a failure.

        Raises:
            GsdmsrError: the training has diverged; the earlier checkpoint stays.
        """
        self._trainer.population.drop_not_finite()
        checkpoint = self._trainer.checkpoint()
        return self._try("checkpoint", lambda: self._run.save(checkpoint), outlook)

    def finish(self) -> None:
        """Save the last checkpoint, and what the log lacks.

        Raises:
            GsdmsrError: the training has diverged; the earlier checkpoint stays.
            DataError: something cannot be written, tried several times.
        """
        for pause in PAUSES:
            if self.save("Trying again"):
                break
            time.sleep(pause)
        else:
            self._save_or_tell()
        if self._lines:
            self._run.log(*self._lines)

    def rescue(self) -> None:
        """Save what an error has left of the training, if that is whole; say so, or why not."""
        if not self._trainer.is_sound:
            return
        try:
            saved = self.save("An error ends the training; the last checkpoint stays")
        except GsdmsrError:  # it has diverged, as the error will say
            return
        if saved:
            step = self._trainer.clock.step
            self._on_warning(f"an error ends the training; --resume goes on from step {step}")

    def _save_or_tell(self) -> None:
        try:
            self._run.save(self._trainer.checkpoint())
        except DataError as error:
            raise DataError(
                f"{error} The training has come to step {self._trainer.clock.step}; the checkpoint "
                "before stays: make room and go on from it with --resume"
            ) from error

    def _try(self, what: str, write: Callable[[], None], outlook: str) -> bool:
        """Return whether something could be written; tell of the first failure in a row."""
        try:
            write()
        except DataError as error:
            if what not in self._told:
                self._on_warning(f"{error} {outlook}")
            self._told.add(what)
            return False
        self._told.discard(what)
        return True
