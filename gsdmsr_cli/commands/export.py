"""gsdmsr export: writes a run's splats for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from gsdmsr_cli import exports
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.ground import say
from gsdmsr_cli.options.preset_files import read_overrides
from gsdmsr_cli.options.strict import Located
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import Run, open_with_model


def run(
    run_folder: Path,
    format_: str,
    time: float | None,
    frames: int | None,
    overrides: Sequence[str],
    out: Path,
) -> None:
    """Write the model of a run to ``out``.

    Args:
        run_folder: the run.
        format_: one of ``exports.format_names()``.
        time: the format's option of this name, or None for its default.
        frames: likewise.
        overrides: "name=value", further options of the format.
        out: file or folder to write.

    Raises:
        UsageError: an option is not the format's or out of range, or the format cannot carry the
            whole model.
        DataError: the run cannot be used, or ``out`` not be written.
    """
    settings = _settings(time, frames, overrides)
    folder, model, checkpoint = open_with_model(run_folder)
    facts = _Source(folder, checkpoint)
    with progress_bar("writing splats") as on_progress, torch.no_grad():
        written = exports.export(format_, model, facts, settings, out, on_progress)
    count, splats = len(written), len(model.splats)
    what = f"{out}" if count == 1 else f"{out}, {count} files"
    document = {"format": format_, "files": [str(path) for path in written], "splats": splats}
    say.result(document, f"wrote {what}: {splats} splats")


@dataclass(frozen=True)
class _Source:
    """What a format may know of the run that is written, see ``exports.RunFacts``."""

    run: Run
    checkpoint: Checkpoint

    @property
    def bound(self) -> float:
        """Half edge of the cube that holds the scene [world units]."""
        return self.run.facts.bound

    @property
    def frames(self) -> int:
        """Number of distinct times of the train views."""
        return self.run.facts.frames

    @property
    def step(self) -> int:
        """Steps that the training has made."""
        return self.checkpoint.step

    @property
    def progress(self) -> float:
        """How far the training has come."""
        return self.checkpoint.progress

    def describe(self, folder: Path) -> None:
        """Write the run's description to another folder."""
        self.run.describe_at(folder)


def _settings(time: float | None, frames: int | None, overrides: Sequence[str]) -> Located:
    """Return all options of the format that are given, each with the place where it was."""
    named = {key: value for key, value in (("time", time), ("frames", frames)) if value is not None}
    further = read_overrides(overrides)
    return Located(named | further, {key: f"--{key}" for key in named} | further.places)
