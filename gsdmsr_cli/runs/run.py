"""Reads and writes run folders: the options, checkpoints and the log of a training.

    RUN/run.json          preset, facts of the scene, where the data lay, versions
    RUN/pictures.json     hashes of the scene's pictures
    RUN/metrics.jsonl     one line per report of the training
    RUN/checkpoint.safetensors   the last checkpoint, with its state as JSON in the header
    RUN/checkpoints/             earlier ones, if any are kept: step-001200.safetensors
    RUN/moments/                 of a stream: a file for each moment, see ``runs.moments``
    RUN/segments/                where time is cut: a run for each segment, see ``runs.segments``
    RUN/training.json     how long the training took, on which machine
    RUN/torchrun.json     which call of torchrun has begun or resumed it, if one has

Every file is written beside its place and then moved there, so an interrupted write leaves the
earlier one. The folder can be moved; nothing in it is pickled.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError

from gsdmsr_cli import __version__
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.renamed import with_present_names
from gsdmsr_cli.runs import (
    checkpoints,
    earlier,
    log,
    moments,
    moving_file,
    seen_pictures,
    segments,
    stream,
)
from gsdmsr_cli.runs.checkpoints import LAST, SCHEMA, WRONG, Checkpoint
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.scene.segments import between

ABOUT = "run.json"
"""The file that makes a folder a run."""

_LOG, _TRAINING, _JOB = "metrics.jsonl", "training.json", "torchrun.json"

OWN = _LOG, _TRAINING, _JOB, seen_pictures.PICTURES
"""Files of a run folder beside its description, its checkpoints and what subfolders hold."""

_READ = 1, SCHEMA


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
        root: the folder.
        name: of the preset, or of the file of options, that the training began from.
        preset: all options of the training.
        facts: what the layers may know of the scene.
        data: folder of the scene, absolute when the run was made; None if that is not told.
        layout: format of the scene.
        fingerprint: of the scene's layout files.
        reason: which preset the data has called for, and why; None where it was named.
        pictures: hash of samples of the scene's pictures; None in runs of earlier versions.
    """

    root: Path
    name: str
    preset: Preset
    facts: Facts
    data: Path | None
    layout: str
    fingerprint: str
    reason: str | None = None
    pictures: str | None = None

    @property
    def log_path(self) -> Path:
        """The log of the training, one JSON object per line."""
        return self.root / _LOG

    @property
    def is_file(self) -> bool:
        """Whether it is a file that stands for a run, see ``runs.moving_file``."""
        return moving_file.is_moving_file(self.root)

    @property
    def results(self) -> Path:
        """The folder in which commands write what they make of the run, if told no other."""
        return moving_file.results_of(self.root) if self.is_file else self.root

    @property
    def checkpoint_path(self) -> Path:
        """The last checkpoint."""
        return self.root if self.is_file else self.root / LAST

    @property
    def has_moments(self) -> bool:
        """Whether it is a stream that has come past its first moment's end."""
        return self.preset.stream.enabled and bool(moments.there(self.root))

    @property
    def training_path(self) -> Path:
        """How long the training took and what it ran on."""
        return self.root / _TRAINING

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is a checkpoint to go on from."""
        return self.checkpoint_path.is_file() or bool(checkpoints.kept(self.root))

    @property
    def job(self) -> str | None:
        """The call of torchrun that has begun or resumed the training last, None if none has.

        Raises:
            DataError: the file that says so cannot be read.
        """
        path = self.root / _JOB
        return str(read_json(path).get("job")) if path.is_file() else None

    @property
    def restarted_at(self) -> int | None:
        """The step at which torchrun has started all ranks anew last, None if it has not.

        Raises:
            DataError: the file that says so cannot be read.
        """
        path = self.root / _JOB
        step = read_json(path).get("restarted_at") if path.is_file() else None
        return None if step is None else int(step)

    def belongs_to(self, job: str, restarted_at: int | None = None) -> None:
        """Note which call of torchrun has begun or resumed the training, and how.

        Args:
            job: see ``job``.
            restarted_at: the step at which all ranks have been started anew, if they have.

        Raises:
            DataError: it cannot be written.
        """
        write_json(self.root / _JOB, {"job": job, "restarted_at": restarted_at})

    def account(self, step: int) -> dict[str, Any]:
        """Return how long the training took that ended at ``step``; {} if none has ended there.

        A training that was killed has none.

        Raises:
            DataError: the file cannot be read.
        """
        written = read_json(self.training_path) if self.training_path.is_file() else {}
        return written if written.get("steps") == step else {}

    def describe(self) -> None:
        """Write what the run is, in place of what was said before."""
        write_json(self.root / ABOUT, self.about())

    def about(self) -> dict[str, Any]:
        """Return what the run is, as plain JSON."""
        return {
            "schema": SCHEMA,
            "gsdmsr": __version__,
            "torch": torch.__version__,
            "name": self.name,
            "reason": self.reason,
            "preset": strict.dump(self.preset),
            "facts": asdict(self.facts),
            "data": {
                "path": None if self.data is None else str(self.data),
                "layout": self.layout,
                "fingerprint": self.fingerprint,
                "pictures": self.pictures,
            },
        }

    def describe_at(self, root: Path) -> None:
        """Describe a run of the same options and scene in another folder, which is made.

        Raises:
            DataError: it cannot be written.
        """
        pictures = self.root / seen_pictures.PICTURES
        replace(self, root=root).describe()
        if pictures.is_file():
            write_json(root / seen_pictures.PICTURES, read_json(pictures))

    def part_of(self, scene: Scene) -> Scene:
        """Return what the run sees of the scene that it was trained on.

        Raises:
            DataError: it is another scene.
        """
        part = between(scene, *self.preset.data.between)
        self.check_part(part)
        return part

    def check_part(self, scene: Scene) -> None:
        """Raise DataError unless the scene is what the run sees of that which it was trained on."""
        if scene.fingerprint != self.fingerprint:
            raise DataError(
                f"{scene.root}: is not the data that {self.root} was trained on (its layout files "
                "differ); give that folder with --data"
            )
        seen_pictures.check(self.root, self.pictures, scene)

    def log(self, *entries: Mapping[str, Any]) -> None:
        """Append lines to the log; see ``runs.log.append``."""
        log.append(self.log_path, entries)

    def read_log(self) -> list[dict[str, Any]]:
        """Return the entries of the log; see ``runs.log.read``."""
        return log.read(self.log_path)

    def rewind_log(self, step: int) -> None:
        """Drop the lines of the log after ``step``; see ``runs.log.rewind``."""
        log.rewind(self.log_path, step)

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the last checkpoint, and keep as many as the preset says.

        Raises:
            DataError: it cannot be written; the earlier ones are still there.
        """
        checkpoints.save(self.root, checkpoint, SCHEMA, self.preset.training.keep)

    def load(self) -> Checkpoint:
        """Read the last checkpoint; one of an earlier version is converted.

        Raises:
            DataError: there is none, or it is damaged.
        """
        path = self.checkpoint_path
        if not self.has_checkpoint:
            if self.preset.segments.several:
                raise DataError(
                    f"{self.root}: not all of its {self.preset.segments.count} segments are "
                    f"trained; go on with train --resume, or name one, such as "
                    f"{segments.folder_of(self.root, 0)}"
                )
            raise DataError(
                f"{self.root}: the run has no checkpoint yet; train it again with --overwrite"
            )
        return self._load(path)

    def load_whole(self) -> tuple[Checkpoint, str | None]:
        """Read the last checkpoint that is whole, and return why it is not the very last one.

        Raises:
            DataError: there is none.
        """
        try:
            checkpoint = self.load()
        except DataError as error:
            reason = error
        else:
            if checkpoint.packed is not None:
                raise DataError(
                    f"{self.root}: holds a packed model, which cannot be trained further; resume "
                    "the run that it was exported from"
                )
            return checkpoint, None
        for path in checkpoints.kept(self.root):
            with suppress(DataError):
                checkpoint = self._load(path)
                return checkpoint, f"{reason}; going on from step {checkpoint.step}, {path.name}"
        raise reason

    def _load(self, path: Path) -> Checkpoint:
        """Read a checkpoint of the run."""
        try:
            checkpoint, schema = checkpoints.read(path)
            if schema >= SCHEMA:
                return checkpoint
            motion = str(self.preset.motion["name"])
            return replace(
                checkpoint,
                tensors=earlier.present_tensors(checkpoint.tensors, motion),
                state=earlier.present_state(checkpoint.state, motion),
            )
        except (SafetensorError, OSError, *WRONG) as error:
            known = path == self.checkpoint_path and checkpoints.kept(self.root)
            remedy = (
                f"train --resume goes on from {known[0].name}, which is kept"
                if known
                else "train again with --overwrite"
            )
            raise DataError(f"{path}: damaged checkpoint: {error}; {remedy}") from error

    def load_model(self) -> tuple[Model, Checkpoint]:
        """Read the model of the last checkpoint, for drawing; of a stream, all moments so far.

        Raises:
            DataError: there is none, or it is not what the run's description says.
        """
        if self.is_file:
            return moving_file.load(self.root)
        checkpoint = stream.load(self.root) if self.has_moments else self.load()
        preset, progress = self.preset, checkpoint.progress
        given = preset.motion, preset.layers, self.facts, progress, preset.training.precision
        try:
            if preset.segments.several:
                model: Model = segments.load(self.root, checkpoint, preset)
            else:
                model = load_model(checkpoint.tensors, *given)
        except GsdmsrError as error:
            raise DataError(f"{self.root}: its model cannot be loaded: {error}") from error
        for tensor in model.tensors().values():
            tensor.requires_grad_(False)
        return model, checkpoint


def is_run(root: Path) -> bool:
    """Return whether ``root`` holds a run's description, not just any file of its name."""
    try:
        about = read_json(root / ABOUT)
    except DataError:
        return False
    return "gsdmsr" in about and "preset" in about and isinstance(about.get("schema"), int)


def open_run(root: Path) -> Run:
    """Open a run folder, or a file that stands for one.

    Raises:
        DataError: the folder is missing or not a run, or its description is damaged.
    """
    path = root / ABOUT
    if moving_file.is_moving_file(root):
        path, about = root, moving_file.about(root)
    elif not path.is_file():
        raise DataError(f"{root}: not a run folder (no {ABOUT}); give one that train wrote")
    else:
        about = read_json(path)
    if about.get("schema") not in _READ:
        known = " and ".join(map(str, _READ))
        raise DataError(f"{path}: has schema {about.get('schema')}; this version reads {known}")
    try:
        options: Mapping[str, Any] = with_present_names(about["preset"])
        if about["schema"] < SCHEMA:
            options = earlier.present_options(options)
        return Run(
            root,
            str(about["name"]),
            strict.build(Preset, options, "preset"),
            strict.build(Facts, about["facts"], "facts"),
            None if about["data"]["path"] is None else Path(about["data"]["path"]),
            str(about["data"]["layout"]),
            str(about["data"]["fingerprint"]),
            about.get("reason"),
            about["data"].get("pictures"),
        )
    except (UsageError, *WRONG) as error:
        raise DataError(f"{path}: damaged: {error}") from error


def open_with_model(root: Path) -> tuple[Run, Model, Checkpoint]:
    """Open a run folder and read the model of its last checkpoint, both of one training.

    A file may stand for both. Where a training goes on, or another begins, they are read again.

    Raises:
        DataError: see ``open_run`` and ``Run.load_model``.
    """
    run, found = open_run(root), None
    while found is None:
        try:
            found = run.load_model()
        except DataError:
            if open_run(root) == run:
                raise
        before, run = run, open_run(root)
        if run != before:
            found = None
    return run, *found
