"""Shows the progress of a training on stderr: a live bar, or plain lines in a log."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn

from gsdmsr_cli.ground import say
from gsdmsr_cli.training.loop import Report

LINE_EVERY = 0.05
"""Progress between two plain lines."""


class TrainingDisplay:
    """A context that is shown every report."""

    def __init__(self, console: Console | None = None) -> None:
        self._console = console or Console(stderr=True)
        self._live: Progress | None = None
        self._task = TaskID(0)
        self._next_line = 0.0
        if self._console.is_terminal and say.shows_progress():
            columns = TextColumn("training"), BarColumn(), TextColumn("{task.description}")
            # few refreshes: the cores are training
            self._live = Progress(*columns, console=self._console, refresh_per_second=2)
            self._task = self._live.add_task("starting", total=1.0)

    def __enter__(self) -> TrainingDisplay:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        where: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, report: Report) -> None:
        """Show a report; one in twenty or so becomes a line, of the log if there is a terminal."""
        if self._live is not None:
            self._live.update(self._task, completed=report.progress, description=describe(report))
        if report.always_told or report.progress >= min(self._next_line, 1.0):
            self._next_line = report.progress + LINE_EVERY
            tell = say.note if self._live is None else say.write_log
            tell(describe(report))


def describe(report: Report) -> str:
    """Return a report as one line; splats are dropped for values that are not finite."""
    psnr = "none" if report.psnr is None else f"{report.psnr:.2f}"
    left = _duration(report.remaining)
    dropped = f" ({report.dropped} dropped)" if report.dropped else ""
    return (
        f"{report.progress:4.0%}  {report.place}step {report.step}  {report.split} PSNR {psnr}  "
        f"{report.splats} splats{dropped}  {report.ms_per_step:.1f} ms/step  {left} left"
    )


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
