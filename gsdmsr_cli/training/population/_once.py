"""What events share that happen once, at a progress."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsdmsr_cli.training.population import Event, Tick


class Once(Event):
    """Happens as training passes a value of progress; a subclass says when it is done.

    Attributes:
        done: whether it has happened.

    Args:
        at: progress from which it is due.
    """

    def __init__(self, at: float) -> None:
        self.at, self.done = at, False

    def due(self, tick: Tick) -> bool:
        """Return whether the progress has been reached, and it has not happened."""
        return not self.done and tick.progress >= self.at

    def state(self) -> dict[str, Any]:
        """Return whether it has happened."""
        return {"done": self.done}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to what ``state`` returned."""
        self.done = bool(state["done"])
