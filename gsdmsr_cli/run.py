"""The folder that train writes: what was asked for, checkpoints and the log of the training.

    RUN/run.json          preset, facts of the scene, where the data lay, versions
    RUN/metrics.jsonl     one line per report of the training
    RUN/checkpoint.safetensors   the last checkpoint, with its state as JSON in the header

Every file is written beside its place and then moved there, so an interrupted write leaves the
earlier one. The folder can be moved; nothing in it is pickled.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from gsdmsr_cli import __version__, strict
from gsdmsr_cli.errors import DataError
from gsdmsr_cli.model import Model, load_model
from gsdmsr_cli.motion import Facts
from gsdmsr_cli.preset import Preset
from gsdmsr_cli.scene import Scene

SCHEMA = 1
_ABOUT, _LOG, _CHECKPOINT = "run.json", "metrics.jsonl", "checkpoint.safetensors"


@dataclass(frozen=True)
class Checkpoint:
    """A moment of the training.

    Attributes:
        step: steps made.
        progress: in [0, 1].
        elapsed: wall time of training so far [s].
        tensors: the model's, and the optimiser's as far as the caller saved them.
        state: everything else that a resumed training needs, plain JSON.
    """

    step: int
    progress: float
    elapsed: float
    tensors: dict[str, Tensor]
    state: dict[str, Any]


@dataclass(frozen=True)
class Run:
    """A run folder.

    Attributes:
        root: the folder.
        preset: all options of the training.
        facts: what the motion was told of the scene.
        data: folder of the scene, absolute when the run was made.
        fingerprint: of the scene's layout files.
    """

    root: Path
    preset: Preset
    facts: Facts
    data: Path
    fingerprint: str

    @property
    def log_path(self) -> Path:
        """The log of the training, one JSON object per line."""
        return self.root / _LOG

    @property
    def checkpoint_path(self) -> Path:
        """The last checkpoint."""
        return self.root / _CHECKPOINT

    def log(self, entry: Mapping[str, Any]) -> None:
        """Append one line to the log."""
        with self.log_path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def save(self, checkpoint: Checkpoint) -> None:
        """Replace the last checkpoint."""
        state = {
            "schema": SCHEMA,
            "step": checkpoint.step,
            "progress": checkpoint.progress,
            "elapsed": checkpoint.elapsed,
            "state": checkpoint.state,
        }
        tensors = {name: t.detach().contiguous() for name, t in checkpoint.tensors.items()}
        beside = self.checkpoint_path.with_suffix(".part")
        try:
            save_file(tensors, beside, metadata={"gsdmsr": json.dumps(state)})
            os.replace(beside, self.checkpoint_path)
        except (OSError, SafetensorError) as error:
            beside.unlink(missing_ok=True)
            raise DataError(f"{self.checkpoint_path}: cannot be written: {error}") from error

    def load(self) -> Checkpoint:
        """Read the last checkpoint.

        Raises:
            DataError: there is none, or it is damaged.
        """
        if not self.checkpoint_path.is_file():
            raise DataError(f"{self.root}: the run has no checkpoint yet; train it first")
        try:
            with safe_open(self.checkpoint_path, framework="pt") as file:
                state = json.loads((file.metadata() or {})["gsdmsr"])
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return Checkpoint(
                int(state["step"]),
                float(state["progress"]),
                float(state["elapsed"]),
                tensors,
                dict(state["state"]),
            )
        except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
            raise DataError(f"{self.checkpoint_path}: damaged checkpoint: {error}") from error

    def load_model(self) -> tuple[Model, Checkpoint]:
        """Read the model of the last checkpoint, for drawing."""
        checkpoint = self.load()
        model = load_model(
            checkpoint.tensors, self.preset.motion, self.facts, checkpoint.progress
        )
        for tensor in model.tensors().values():
            tensor.requires_grad_(False)
        return model, checkpoint


def create_run(
    root: Path, preset: Preset, facts: Facts, scene: Scene, overwrite: bool = False
) -> Run:
    """Start a run folder.

    Raises:
        DataError: the folder is in use and ``overwrite`` is not set, or is not a run at all, or
            cannot be written.
    """
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        if not (root / _ABOUT).is_file():
            raise DataError(f"{root}: exists and is not a run folder; choose another --out")
        if not overwrite:
            raise DataError(
                f"{root}: holds a run; continue it with --resume or replace it with --overwrite"
            )
        shutil.rmtree(root)
    run = Run(root, preset, facts, scene.root.resolve(), scene.fingerprint)
    about = {
        "schema": SCHEMA,
        "gsdmsr": __version__,
        "torch": torch.__version__,
        "preset": strict.dump(preset),
        "facts": asdict(facts),
        "data": {
            "path": str(run.data),
            "layout": scene.layout,
            "fingerprint": scene.fingerprint,
        },
    }
    try:
        root.mkdir(parents=True, exist_ok=True)
        beside = root / f"{_ABOUT}.part"
        beside.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
        os.replace(beside, root / _ABOUT)
    except OSError as error:
        raise DataError(f"{root}: cannot be written: {error.strerror}") from error
    return run


def open_run(root: Path) -> Run:
    """Open a run folder.

    Raises:
        DataError: the folder is missing or not a run, or its description is damaged.
    """
    path = root / _ABOUT
    if not path.is_file():
        raise DataError(f"{root}: not a run folder (no {_ABOUT}); give one that train wrote")
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        return Run(
            root,
            strict.build(Preset, about["preset"], str(path)),
            Facts(**about["facts"]),
            Path(about["data"]["path"]),
            str(about["data"]["fingerprint"]),
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: damaged: {error}") from error
