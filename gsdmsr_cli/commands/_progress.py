"""The progress bar of every command: on stderr, and only where someone watches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress

Tell = Callable[[int, int], None]
"""Called with how much is done, and of how much."""


@contextmanager
def progress_bar(description: str) -> Iterator[Tell]:
    """Show a bar that disappears at the end; yield what moves it."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


def part_of(tell: Tell, before: int, total: int) -> Callable[[int], None]:
    """Return what tells of a part of the work, of which so much was done before."""
    return lambda done: tell(before + done, total)
