"""The options of ``gsdmsr train``, checked as far as that is possible without the data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsdmsr_cli.ground.errors import UsageError


@dataclass(frozen=True)
class Request:
    """The options of ``gsdmsr train``.

    Attributes:
        data: folder of the scene.
        out: the run folder.
        preset: the preset that is named, or None.
        config: file of options, or None.
        overrides: "a.b=value" texts, which win over both.
        device: "auto", "cpu" or "cuda".
        resume: go on from the last checkpoint of ``out``.
        overwrite: replace an earlier run there.
        dry_run: check everything and say what would be done; nothing is written.
        verify: take hashes of whole pictures, which a resumed training compares.
        tensorboard: hand the reports to TensorBoard.
        wandb: project of Weights & Biases that gets them, or None.
        jobs: segments that are trained side by side.
        workers: of Ray, that train them, see ``calling.on_ray.connected``; None trains them here.
        view_port: of the page that shows the training, 0 for a free one; None serves none.

    Raises:
        UsageError: two options exclude each other.
    """

    data: Path
    out: Path
    preset: str | None = None
    config: Path | None = None
    overrides: tuple[str, ...] = ()
    device: str = "auto"
    resume: bool = False
    overwrite: bool = False
    dry_run: bool = False
    verify: bool = False
    tensorboard: bool = False
    wandb: str | None = None
    view_port: int | None = None
    jobs: int = 1
    workers: str | None = None

    def __post_init__(self) -> None:
        if self.resume and self.overwrite:
            raise UsageError("--resume and --overwrite are both given; drop one")
        if self.jobs > 1 and self.workers is not None:
            raise UsageError("--jobs and --workers are both given; drop one")
