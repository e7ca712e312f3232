"""gsdmsr export: writes a run's splats for other programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from gsdmsr_cli import exports
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._showing import judge_of, read_data, scene_facts
from gsdmsr_cli.drawing.judging import Judge
from gsdmsr_cli.ground import say
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset_files import read_overrides
from gsdmsr_cli.options.strict import Located
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.moving_file import bytes_of
from gsdmsr_cli.runs.run import Run, open_with_model
from gsdmsr_cli.scene.scene import Scene


def run(
    run_folder: Path,
    format_: str,
    named: Mapping[str, object],
    overrides: Sequence[str],
    out: Path,
    data: Path | None = None,
) -> None:
    """Write the model of a run to ``out`` and tell, see ``write``."""
    written = write(run_folder, format_, named, overrides, out, data)
    count, splats = len(written.files), written.splats
    what = f"{out}" if count == 1 else f"{out}, {count} files"
    files = [str(path) for path in written.files]
    document = {"format": format_, "files": files, "splats": splats, "lost": written.lost}
    say.result(document | written.details, f"wrote {what}: {splats} splats", *_told(written))


def write(
    run_folder: Path,
    format_: str,
    named: Mapping[str, object],
    overrides: Sequence[str],
    out: Path,
    data: Path | None = None,
) -> exports.Written:
    """Write the model of a run to ``out``.

    Args:
        run_folder: the run.
        format_: one of ``exports.format_names()``.
        named: options that were given by names of their own.
        overrides: "name=value", further options of the format.
        out: file or folder to write.
        data: where the data lies now, for formats that measure what they lose.

    Raises:
        UsageError: an option is not the format's or out of range, or the format cannot carry the
            whole model.
        DataError: the run cannot be used, or ``out`` not be written.
    """
    settings = _settings(named, overrides)
    folder, model, checkpoint = open_with_model(run_folder)
    facts = _Source(folder, checkpoint, data)
    with progress_bar("writing splats") as on_progress, torch.no_grad():
        return exports.export(format_, model, facts, settings, out, on_progress)


def _told(written: exports.Written) -> list[str | Table]:
    """Return what is to be told of a file that is played: what coding has cost, and its bytes."""
    details = written.details
    if "bytes_of" not in details:
        return []
    table = Table("part", "bytes", title=f"{details['bytes']} bytes")
    table.columns[1].justify = "right"
    for name, size in sorted(details["bytes_of"].items(), key=lambda item: -item[1]):
        table.add_row(name, str(size))
    psnr = "" if details["psnr"] is None else f" of {details['psnr']:.2f}"
    return [f"coding loses {details['loss_db']:.3f} dB{psnr} on {details['measured_on']}", table]


@dataclass(frozen=True)
class _Source:
    """What a format may know of the run that is written, see ``exports.RunFacts``."""

    run: Run
    checkpoint: Checkpoint
    data: Path | None

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

    def file(self) -> bytes | None:
        """Return the file that stands for the run, if one does."""
        return bytes_of(self.run.root) if self.run.is_file else None

    def about(self) -> dict[str, Any]:
        """Return the run's description, without the place of its data."""
        about = self.run.about()
        told = {"step": self.step, "progress": self.progress}
        return about | {"data": about["data"] | {"path": None}} | told

    @cached_property
    def _scene(self) -> Scene | None:
        return read_data(self.run, self.data)

    def shown(self, model: Model) -> dict[str, Any]:
        """Return what a player is told of the scene."""
        return scene_facts(self.run, model, self._scene)

    def judge(self, model: Model) -> Judge:
        """Return what compares others with a model."""
        return judge_of(self.run, model, self._scene)


def _settings(named: Mapping[str, object], overrides: Sequence[str]) -> Located:
    """Return all options that are given, each with the place where it was."""
    further = read_overrides(overrides)
    places = {key: f"--{key.replace('_', '-')}" for key in named}
    return Located({**named, **further}, places | further.places)
