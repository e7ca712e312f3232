"""Shows progress bars on stderr, if that is a terminal."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.progress import OnProgress


@contextmanager
def progress_bar(description: str, console: Console | None = None) -> Iterator[OnProgress]:
    """Show a bar that disappears at the end; yield the function that moves it.

    Beside it stand what is done, the time that has gone and the time that is left.
    """
    console = console or Console(stderr=True)
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    hidden = not (console.is_terminal and say.shows_progress())
    with Progress(*columns, console=console, transient=True, disable=hidden) as progress:
        task = progress.add_task(description, total=None)
        started = time.perf_counter()
        yield lambda done, total: progress.update(task, completed=done, total=total)
    say.detail(f"{description}: {time.perf_counter() - started:.1f} s")


def part_of(on_progress: OnProgress, before: int, total: int) -> Callable[[int], None]:
    """Return what reports the progress of a part, before which so much of the work was done."""
    return lambda done: on_progress(before + done, total)
