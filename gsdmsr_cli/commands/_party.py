"""The ranks of a training before and after its steps, as one of them sees the others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gsdmsr_cli.ground import limits
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import Preset, TrainingOptions
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.ranks.alone import ALONE, Ranks
from gsdmsr_cli.training.trainer import Trainer


class Party:
    """The ranks of a training before and after its steps; without torchrun there is one.

    Attributes:
        ranks: for the trainer.
        restarts: how often torchrun has started all ranks anew, since one has ended.
        beside: how many of the ranks are on this machine.
        job: what tells this call of torchrun from others, the same after a restart; or None.
    """

    def __init__(
        self, ranks: Ranks = ALONE, restarts: int = 0, beside: int = 1, job: str | None = None
    ) -> None:
        self.ranks, self.restarts, self.beside, self.job = ranks, restarts, beside, job

    @property
    def leads(self) -> bool:
        """Whether this process keeps the run folder."""
        return self.ranks.rank == 0

    def threads(self, options: TrainingOptions) -> int:
        """Return the threads of this process: as asked, or its share of the machine; 0 is all."""
        if options.threads or self.beside == 1:
            return options.threads
        return max(1, limits.cores() // self.beside)

    def level(self, trainer: Trainer) -> None:
        """Let all ranks go on from where the first one is."""

    def tell(self, value: Any) -> Any:
        """Return what the first rank has; what the others have does not count."""
        return value

    @contextmanager
    def all_or_none(self) -> Iterator[None]:
        """Let an error of one rank in the block end all of them, and the first one name it.

        Raises:
            DataError, UsageError: another rank cannot go on.
            SystemExit: the same, where this is not the first rank: one line is enough.
        """
        yield

    def require_same(self, scene: Scene) -> None:
        """Raise DataError in the first rank unless all have its data, versions and processor."""


def require_alone(party: Party) -> None:
    """Raise UsageError if several ranks are to train segments, which are trainings of their own."""
    if party.ranks.size > 1:
        raise UsageError(
            f"{party.ranks.size} ranks cannot share segments, each of which is a training of its "
            "own; leave torchrun out, and give --jobs or --workers"
        )


def require_suited(party: Party, options: Preset, device: str) -> None:
    """Raise UsageError if the ranks cannot share the steps of a training with these options."""
    size, views = party.ranks.size, options.training.views_on(device)
    if size > 1 and device != "cpu":
        raise UsageError(
            f"{size} ranks train on CPUs alone: sums of a GPU differ from rank to rank; give "
            "--device cpu"
        )
    if size > 1 and options.stream.enabled:
        raise UsageError(f"{size} ranks cannot share a stream: train it in one process")
    if size > views:
        raise UsageError(
            f"{size} ranks share the views of a step, and training.views_per_step is {views}; "
            "start no more ranks than that, or raise it"
        )
