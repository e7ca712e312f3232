"""Shows the stages of a long command on stderr, as bars or plain lines, and keeps their times."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console

from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.progress import OnProgress

LINE_EVERY = 15.0
"""Seconds between the lines on a stage that takes long, where no terminal shows a bar."""

OTHER = "other"
"""What the time outside of all stages is called."""


class StagesDisplay:
    """Shows one stage after the other; its clock runs from when it is made."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._started = time.perf_counter()
        self._seconds: dict[str, float] = {}

    @contextmanager
    def show(self, description: str) -> Iterator[OnProgress]:
        """Show a stage; yield the function that its progress is reported to."""
        name = description
        while name in self._seconds:
            name += " again"
        started = time.perf_counter()
        try:
            with (
                progress_bar(name, self._console)
                if self._console.is_terminal
                else _lines(name, self._console)
            ) as on_progress:
                yield on_progress
        finally:
            self._seconds[name] = round(time.perf_counter() - started, 2)

    def seconds(self) -> dict[str, float]:
        """Return the time of every stage so far and of all else; the sum is the wall time [s]."""
        total = time.perf_counter() - self._started
        other = round(max(total - sum(self._seconds.values()), 0.0), 2)
        return {**self._seconds, OTHER: other}


@contextmanager
def _lines(name: str, console: Console) -> Iterator[OnProgress]:
    """Print a line when a stage begins and ends, and how far it is while it lasts."""
    latest, ended, started = _Latest(), threading.Event(), time.perf_counter()

    def tell(text: str) -> None:
        _print(console, f"{name}: {text}")

    def keep_telling() -> None:
        while not ended.wait(LINE_EVERY):
            tell(latest.describe(time.perf_counter() - started))

    teller = threading.Thread(target=keep_telling, name="stage", daemon=True)
    _print(console, f"{name} ...")
    teller.start()
    try:
        yield latest.take
        ended.set()
        teller.join()
        count = f"{latest.total} " if latest.total else ""
        tell(f"{count}in {time.perf_counter() - started:.1f} s")
    finally:
        ended.set()
        teller.join()


def _print(console: Console, line: str) -> None:
    if say.shows_progress():
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    say.write_log(line)


class _Latest:
    """How much of a stage is done, and of how much."""

    def __init__(self) -> None:
        self.done, self.total = 0, 0

    def take(self, done: int, total: int) -> None:
        self.done, self.total = done, total

    def describe(self, elapsed: float) -> str:
        """Return how far the stage has come after so many seconds."""
        if not self.done or not self.total:
            return f"{elapsed:.0f} s so far"
        left = elapsed / self.done * max(self.total - self.done, 0)
        return f"{self.done} of {self.total}, {elapsed:.0f} s so far, about {left:.0f} s left"
