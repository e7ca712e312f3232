"""One file per export format.

A format is a module of this package with one function::

    def export(model: MovingSplats, target: Path, options: ExportOptions) -> list[Path]
        # writes the model to target and returns the files written
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from gsdmsr_cli.errors import UsageError

if TYPE_CHECKING:  # Splats brings torch, which --help must not wait for
    from gsdmsr_cli.splats import Splats


class MovingSplats(Protocol):
    """What can be exported: splats at any time."""

    def at(self, time: float) -> Splats:
        """Return the splats at ``time`` in [0, 1]."""


class Exporter(Protocol):
    """What a module of this package offers."""

    def export(self, model: MovingSplats, target: Path, options: ExportOptions) -> list[Path]:
        """Write ``model`` to ``target`` and return the files written."""


@dataclass(frozen=True)
class ExportOptions:
    """When to look at the splats.

    Attributes:
        time: the moment that a still format shows, in [0, 1].
        frames: number of moments that a format with motion shows, evenly over [0, 1], both ends
            included; 0 for ``times``.
        times: the moments, each in [0, 1].
        progress: called with (files written, files in all) after each file.

    Raises:
        UsageError: a time outside [0, 1], or fewer than 0 frames.
    """

    time: float = 0.0
    frames: int = 0
    times: tuple[float, ...] = ()
    progress: Callable[[int, int], None] | None = None

    def __post_init__(self) -> None:
        for time in (self.time, *self.times):
            if not 0.0 <= time <= 1.0:
                raise UsageError(f"time {time} is outside [0, 1], from the first frame to the last")
        if self.frames < 0:
            raise UsageError(f"{self.frames} frames cannot be exported; --frames takes 1 or more")

    def moments(self) -> tuple[float, ...]:
        """Return the moments that ``frames`` or else ``times`` ask for; one frame shows time 0."""
        if self.frames:
            return tuple(i / max(self.frames - 1, 1) for i in range(self.frames))
        return self.times

    def tell(self, done: int, total: int) -> None:
        """Report progress, if anyone listens."""
        if self.progress is not None:
            self.progress(done, total)
