"""Reads and writes run folders: the options, checkpoints and the log of a training.

    RUN/run.json          preset, facts of the scene, where the data lay, versions
    RUN/metrics.jsonl     one line per report of the training
    RUN/checkpoint.safetensors   the last checkpoint, with its state as JSON in the header
    RUN/training.json     how long the training took, on which machine

Every file is written beside its place and then moved there, so an interrupted write leaves the
earlier one. The folder can be moved; nothing in it is pickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save_file
from torch import Tensor

from gsdmsr_cli import __version__
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.ground.files import leftovers, read_json, replacing, write_json
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.options.renamed import with_present_names
from gsdmsr_cli.runs import earlier
from gsdmsr_cli.scene.scene import Scene

SCHEMA = 2
"""Of ``run.json`` and checkpoints. In 1, before version 0.2, the motion ``control_points`` and its
tensor were called ``nodes``, and checkpoints counted events otherwise; 1 is converted when read."""

_READ = 1, SCHEMA
_WRONG = LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError
"""What values of other kinds than were written end in."""

_ABOUT, _LOG, _CHECKPOINT = "run.json", "metrics.jsonl", "checkpoint.safetensors"
_TRAINING = "training.json"


OUTPUTS = "eval", "render"
"""Folders in that of a run which the commands of these names write, if told no other."""


@dataclass(frozen=True)
class Checkpoint:
    """A moment of the training.

    Attributes:
        step: steps made.
        progress: in [0, 1].
        elapsed: wall time of training so far [s].
        tensors: the model's, and the optimiser's as far as the caller saved them.
        state: everything else that a resumed training needs, plain JSON.
        sha256: of the file that it was read from; empty where it was not.
        file_bytes: size of that file.
    """

    step: int
    progress: float
    elapsed: float
    tensors: dict[str, Tensor]
    state: dict[str, Any]
    sha256: str = ""
    file_bytes: int = 0


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
        root: the folder.
        name: of the preset, or of the file of options, that the training began from.
        preset: all options of the training.
        facts: what the layers may know of the scene.
        data: folder of the scene, absolute when the run was made.
        layout: format of the scene.
        fingerprint: of the scene's layout files.
        reason: which preset the data has called for, and why; None where it was named.
    """

    root: Path
    name: str
    preset: Preset
    facts: Facts
    data: Path
    layout: str
    fingerprint: str
    reason: str | None = None

    @property
    def log_path(self) -> Path:
        """The log of the training, one JSON object per line."""
        return self.root / _LOG

    @property
    def checkpoint_path(self) -> Path:
        """The last checkpoint."""
        return self.root / _CHECKPOINT

    @property
    def training_path(self) -> Path:
        """How long the training took and what it ran on."""
        return self.root / _TRAINING

    def describe(self) -> None:
        """Write what the run is, in place of what was said before."""
        about = {
            "schema": SCHEMA,
            "gsdmsr": __version__,
            "torch": torch.__version__,
            "name": self.name,
            "reason": self.reason,
            "preset": strict.dump(self.preset),
            "facts": asdict(self.facts),
            "data": {
                "path": str(self.data),
                "layout": self.layout,
                "fingerprint": self.fingerprint,
            },
        }
        write_json(self.root / _ABOUT, about)

    def check_scene(self, scene: Scene) -> None:
        """Raise DataError unless the scene is the one that the run was trained on."""
        if scene.fingerprint != self.fingerprint:
            raise DataError(
                f"{scene.root}: is not the data that {self.root} was trained on (its layout files "
                "differ); give that folder with --data"
            )

    def log(self, entry: Mapping[str, Any]) -> None:
        """Append one line to the log."""
        with self.log_path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, allow_nan=False) + "\n")

    def read_log(self) -> list[dict[str, Any]]:
        """Return the entries of the log, without a last one that a killed training has cut short.

        Raises:
            DataError: the log cannot be read or is damaged.
        """
        if not self.log_path.is_file():
            return []
        try:
            *lines, _ = self.log_path.read_text(encoding="utf-8").split("\n")
            return [dict(json.loads(line)) for line in lines]
        except (OSError, *_WRONG) as error:
            raise DataError(f"{self.log_path}: cannot be read: {error}") from error

    def rewind_log(self, step: int) -> None:
        """Drop the lines of the log after ``step``, and one whose writing was interrupted."""
        if not self.log_path.is_file():
            return
        lines = self.log_path.read_text(encoding="utf-8").splitlines(keepends=True)
        kept = [line for line in lines if _is_up_to(step, line)]
        with replacing(self.log_path) as beside:
            beside.write_text("".join(kept), encoding="utf-8")

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the last checkpoint.

        Raises:
            DataError: it cannot be written; the earlier one is still there.
        """
        state = {
            "schema": SCHEMA,
            "step": checkpoint.step,
            "progress": checkpoint.progress,
            "elapsed": checkpoint.elapsed,
            "state": checkpoint.state,
        }
        tensors = {name: t.detach().contiguous() for name, t in checkpoint.tensors.items()}
        with replacing(self.checkpoint_path) as beside:
            try:
                save_file(tensors, beside, metadata={"gsdmsr": json.dumps(state)})
            except SafetensorError as error:
                raise OSError(str(error)) from error

    def load(self) -> Checkpoint:
        """Read the last checkpoint; one of an earlier version is converted.

        Raises:
            DataError: there is none, or it is damaged.
        """
        if not self.checkpoint_path.is_file():
            raise DataError(
                f"{self.root}: the run has no checkpoint yet; train it again with --overwrite"
            )
        try:
            data = self.checkpoint_path.read_bytes()  # at once: a training may replace the file
            state = json.loads(_metadata(data)["gsdmsr"])
            tensors = load_tensors(data)
            training = dict(state["state"])
            if int(state["schema"]) < SCHEMA:
                motion = str(self.preset.motion["name"])
                tensors = earlier.present_tensors(tensors, motion)
                training = earlier.present_state(training, motion)
            return Checkpoint(
                int(state["step"]),
                float(state["progress"]),
                float(state["elapsed"]),
                tensors,
                training,
                hashlib.sha256(data).hexdigest(),
                len(data),
            )
        except (SafetensorError, OSError, *_WRONG) as error:
            raise DataError(
                f"{self.checkpoint_path}: damaged checkpoint: {error}; train again with --overwrite"
            ) from error

    def load_model(self) -> tuple[Model, Checkpoint]:
        """Read the model of the last checkpoint, for drawing.

        Raises:
            DataError: there is none, or it is not what the run's description says.
        """
        checkpoint = self.load()
        preset, progress = self.preset, checkpoint.progress
        given = preset.motion, preset.layers, self.facts, progress, preset.training.precision
        try:
            model = load_model(checkpoint.tensors, *given)
        except GsdmsrError as error:
            raise DataError(f"{self.root}: its model cannot be loaded: {error}") from error
        for tensor in model.tensors().values():
            tensor.requires_grad_(False)
        return model, checkpoint


def is_run(root: Path) -> bool:
    """Return whether ``root`` holds a run's description, not just any file of its name."""
    try:
        return "gsdmsr" in read_json(root / _ABOUT)
    except DataError:
        return False


def refuse_used(root: Path, overwrite: bool) -> None:
    """Raise DataError unless a run may be started in the folder ``root``."""
    if not root.exists():
        _require_place(root)
        return
    if root.is_dir() and not any(root.iterdir()):
        return
    if not is_run(root):
        raise DataError(f"{root}: exists and is not a run folder; choose another --out")
    if not overwrite:
        raise DataError(
            f"{root}: holds a run; continue it with --resume or replace it with --overwrite"
        )


def create_run(
    root: Path,
    name: str,
    preset: Preset,
    facts: Facts,
    scene: Scene,
    overwrite: bool = False,
    reason: str | None = None,
) -> Run:
    """Start a run folder; an earlier run there is deleted if ``overwrite`` says so.

    ``reason`` is which preset the data has called for, and why.

    Raises:
        DataError: the folder is in use and ``overwrite`` is not set, or is not a run at all, or
            holds the scene, or cannot be written.
    """
    refuse_used(root, overwrite)
    data = scene.root.resolve()
    if data.is_relative_to(root.resolve()):
        raise DataError(f"{root}: holds the data {scene.root}; choose another --out")
    if root.exists():
        _clear(root)
    run = Run(root, name, preset, facts, data, scene.layout, scene.fingerprint, reason)
    run.describe()
    return run


def continue_run(run: Run, preset: Preset, scene: Scene) -> Run:
    """Return the run with other options, and with its scene at another place; both written down.

    Raises:
        DataError: the scene is not the run's, or the folder cannot be written.
    """
    run.check_scene(scene)
    for left in leftovers(run.root):
        left.unlink()  # a killed training was writing them
    continued = replace(run, preset=preset, data=scene.root.resolve())
    continued.describe()
    return continued


def open_run(root: Path) -> Run:
    """Open a run folder.

    Raises:
        DataError: the folder is missing or not a run, or its description is damaged.
    """
    path = root / _ABOUT
    if not path.is_file():
        raise DataError(f"{root}: not a run folder (no {_ABOUT}); give one that train wrote")
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
            Path(about["data"]["path"]),
            str(about["data"]["layout"]),
            str(about["data"]["fingerprint"]),
            about.get("reason"),
        )
    except (UsageError, *_WRONG) as error:
        raise DataError(f"{path}: damaged: {error}") from error


def open_with_model(root: Path) -> tuple[Run, Model, Checkpoint]:
    """Open a run folder and read the model of its last checkpoint, both of one training.

    A training may go on there, or another begin: then they are read again.

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


def _metadata(data: bytes) -> dict[str, str]:
    """Return what the header of a safetensors file says beside its tensors."""
    length = int.from_bytes(data[:8], "little")
    return dict(json.loads(data[8 : 8 + length])["__metadata__"])


def _clear(root: Path) -> None:
    """Empty the folder of a run; the folder itself, which may be a link or a mount, stays."""
    for entry in root.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _require_place(root: Path) -> None:
    """Raise DataError unless the folder ``root``, which is not there yet, can be made."""
    nearest = next(parent for parent in root.absolute().parents if parent.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        problem = "cannot be written" if nearest.is_dir() else "is a file"
        raise DataError(f"{root}: cannot be made, since {nearest} {problem}; choose another --out")


def _is_up_to(step: int, line: str) -> bool:
    try:
        return bool(json.loads(line)["step"] <= step)
    except (ValueError, LookupError, TypeError):
        return False
