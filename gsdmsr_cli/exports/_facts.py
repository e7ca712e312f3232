"""What exporters may know of a run beside its model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:  # Model brings torch, which --help must not wait for
    from gsdmsr_cli.drawing.judging import Judge
    from gsdmsr_cli.model.model import Model


class Facts(Protocol):
    """What an exporter may know of the scene besides the model; ``run.json`` holds it."""

    @property
    def bound(self) -> float:
        """Half edge of the cube around the origin that holds the scene [world units]."""

    @property
    def frames(self) -> int:
        """Number of distinct times of the train views."""


class RunFacts(Facts, Protocol):
    """What the command gives beside it, for formats that are a run themselves or are played."""

    @property
    def step(self) -> int:
        """Steps that the training has made."""

    @property
    def progress(self) -> float:
        """How far the training has come, in [0, 1]."""

    def describe(self, folder: Path) -> None:
        """Write to a new folder what the run's own says of its options, its scene and pictures."""

    def file(self) -> bytes | None:
        """Return the ``.dsplat`` that stands for the run, or None if it is a folder."""

    def about(self) -> dict[str, Any]:
        """Return the run's options and scene as plain JSON, without any place on this machine."""

    def shown(self, model: Model) -> dict[str, Any]:
        """Return what a player is told of the scene, see docs/file-format.md."""

    def judge(self, model: Model) -> Judge:
        """Return what compares others with a model.

        Raises:
            DataError: the data is not the run's, or its pictures cannot be read.
        """
