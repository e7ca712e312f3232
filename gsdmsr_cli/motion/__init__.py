"""One file per motion: how splats move over time.

A motion is a module of this package with ``Options``, a frozen dataclass of its settings, and
``start(options, facts, count, generator) -> Motion``, which begins as the identity. Motions never
import one another; what they share lies in ``gsdmsr_cli.fields``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsdmsr_cli import plugins, strict
from gsdmsr_cli.fields.planes import Box
from gsdmsr_cli.splats import Splats


@dataclass(frozen=True)
class Facts:
    """What a motion may know of its scene; saved with every run.

    Attributes:
        bound: half edge of the cube around the origin that holds the scene [world units].
        box: lower and upper corner of where the canonical splats are [world units].
        frames: number of distinct train times.
    """

    bound: float
    box: Box
    frames: int


class Motion(Protocol):
    """How N canonical splats move over time; mutable, since training changes its tensors."""

    def at(self, splats: Splats, time: float) -> Splats:
        """Return the splats at ``time`` in [0, 1]; row i of the result is row i of ``splats``."""

    def take(self, rows: Tensor) -> None:
        """Follow ``splats.take(rows)``: resize whatever is held per splat."""

    def advance(self, progress: float) -> None:
        """Enter the phase of training that belongs to ``progress`` in [0, 1]."""

    def penalty(self, splats: Splats, time: float, generator: torch.Generator) -> Tensor | None:
        """Return the motion's regularisers at the present values, or None if it has none.

        What depends on positions or time is looked at for ``splats`` at ``time``; ``generator`` is
        the source of random choices.
        """

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that is trained or saved, by name, in a fixed order."""

    def groups(self) -> dict[str, str]:
        """Return, for every trained tensor, which of the preset's learning rates it follows.

        "planes" or "network" where all splats share it; "embeddings" or the name of a splat's
        tensor, such as "means", where it has a row for each of them.
        """


@runtime_checkable
class Rooted(Motion, Protocol):
    """A motion that is tied to where the canonical splats are."""

    def root(self, splats: Splats) -> Sequence[str]:
        """Tie the motion anew to the splats, of which there are others than before.

        Called without a graph as motion begins and after splats were grown. Shapes stay.

        Returns:
            the names of its tensors that have new values.
        """


@runtime_checkable
class MovingAtOnce(Motion, Protocol):
    """A motion that moves splats to several times with less work than one after the other."""

    def at_times(self, splats: Splats, times: Sequence[float]) -> list[Splats]:
        """Return what ``at`` does at each of the times."""


def motion_options(settings: Mapping[str, Any]) -> Any:
    """Return the ``Options`` that ``settings`` ask for, of the motion ``settings["name"]``.

    Raises:
        UsageError: no motion has that name, or an option is unknown or out of range.
    """
    return _plugin(settings)[1]


def start_motion(
    settings: Mapping[str, Any], facts: Facts, count: int, generator: torch.Generator
) -> Motion:
    """Make the motion ``settings["name"]`` of ``count`` splats, with the other settings as options.

    Raises:
        UsageError: see ``motion_options``.
    """
    module, options = _plugin(settings)
    motion: Motion = module.start(options, facts, count, generator)
    return motion


def _plugin(settings: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return the motion's module and its options."""
    module: Any = plugins.load(__name__, str(settings.get("name", "")))
    located = settings if isinstance(settings, strict.Located) else strict.Located(settings)
    return module, strict.build(module.Options, located.without("name"), "motion")
