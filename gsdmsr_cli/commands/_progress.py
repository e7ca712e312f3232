"""Shows progress bars on stderr, if that is a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

from gsdmsr_cli.ground.progress import OnProgress


@contextmanager
def progress_bar(description: str) -> Iterator[OnProgress]:
    """Show a bar that disappears at the end; yield the function that moves it."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def part_of(on_progress: OnProgress, before: int, total: int) -> Callable[[int], None]:
    """Return what reports the progress of a part, before which so much of the work was done."""
    return lambda done: on_progress(before + done, total)
