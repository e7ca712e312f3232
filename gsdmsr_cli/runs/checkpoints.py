"""The checkpoints in a run folder: the last one, of which one is always whole, and earlier ones."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save_file
from torch import Tensor

from gsdmsr_cli.ground.files import (
    remove_if_empty,
    remove_leftovers,
    replacing,
    written_apart,
)
from gsdmsr_cli.runs.packing import unpack

LAST = "checkpoint.safetensors"
"""Name of the last checkpoint."""

SCHEMA = 2
"""Of ``run.json`` and checkpoints. In 1, before version 0.2, the motion ``control_points`` and its
tensor were called ``nodes``, and checkpoints counted events otherwise; 1 is converted when read."""

WRONG = LookupError, TypeError, ValueError, AttributeError, OverflowError, RecursionError
"""What values of other kinds than were written end in."""

_EARLIER = "checkpoints"
_KEPT = re.compile(r"step-(\d{6,})\.safetensors")


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
        packed: bytes of each tensor in that file, where it is packed, see ``runs.packing``; such a
            checkpoint can be drawn, and not be trained further.
    """

    step: int
    progress: float
    elapsed: float
    tensors: dict[str, Tensor]
    state: dict[str, Any]
    sha256: str = ""
    file_bytes: int = 0
    packed: Mapping[str, int] | None = None

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each tensor, as they are stored."""
        own = {name: tensor.nbytes for name, tensor in self.tensors.items()}
        return own if self.packed is None else dict(self.packed)


def save(root: Path, checkpoint: Checkpoint, schema: int, count: int) -> None:
    """Replace the last checkpoint in a run folder as soon as the new one is known to be whole.

    Args:
        root: the run folder.
        checkpoint: the new one.
        schema: of the file.
        count: how many to keep, the new one counted.

    Raises:
        DataError: it cannot be written; the earlier ones are still there.
    """
    with replacing(root / LAST) as beside:
        try:
            _write(beside, checkpoint, schema)
            if _step_of(beside) != checkpoint.step:
                raise OSError("what was written cannot be read back")
        except SafetensorError as error:
            raise OSError(str(error)) from error
        if count > 1:
            _keep_last(root)
    with suppress(OSError):  # one too many does no harm
        _remove_kept(root, kept(root)[count - 1 :])


def remove(root: Path) -> None:
    """Remove all checkpoints of a run folder."""
    (root / LAST).unlink(missing_ok=True)
    _remove_kept(root, kept(root))


def _remove_kept(root: Path, paths: Sequence[Path]) -> None:
    folder = root / _EARLIER
    if folder.is_dir() and not folder.is_symlink():
        remove_leftovers(folder)
        for path in paths:
            path.unlink()
        remove_if_empty(folder)


def _write(path: Path, checkpoint: Checkpoint, schema: int) -> None:
    state = {
        "schema": schema,
        "step": checkpoint.step,
        "progress": checkpoint.progress,
        "elapsed": checkpoint.elapsed,
        "state": checkpoint.state,
    }
    tensors = {name: t.detach().contiguous() for name, t in checkpoint.tensors.items()}
    with written_apart(path) as own:
        save_file(tensors, own, metadata={"gsdmsr": json.dumps(state)})


def _keep_last(root: Path) -> None:
    """Give the last checkpoint, which is to be replaced, a second name, if it is whole."""
    last = root / LAST
    try:
        step = _step_of(last)
    except (OSError, SafetensorError, *WRONG):
        return
    path = root / _EARLIER / f"step-{step:06d}.safetensors"
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as beside:
        try:
            os.link(last, beside)
        except OSError:  # drives that have no hard links
            shutil.copyfile(last, beside)


def kept(root: Path) -> list[Path]:
    """Return the earlier checkpoints that are kept in a run folder, the latest first."""
    try:
        found = [path for path in (root / _EARLIER).iterdir() if _KEPT.fullmatch(path.name)]
    except OSError:
        return []
    return sorted(found, key=lambda path: int(path.stem.removeprefix("step-")), reverse=True)


def _step_of(path: Path) -> int:
    """Return the step of a checkpoint whose header and length are right.

    Raises:
        SafetensorError, OSError, WRONG: they are not.
    """
    with safe_open(path, framework="pt") as file:
        return int(json.loads((file.metadata() or {})["gsdmsr"])["step"])


def read(path: Path) -> tuple[Checkpoint, int]:
    """Return a checkpoint as it stands in its file, and its schema.

    Raises:
        SafetensorError, OSError, WRONG: it is damaged or not there.
        DataError: another version has packed it.
    """
    data = path.read_bytes()  # at once: a training may replace the file
    about = json.loads(_metadata(data)["gsdmsr"])
    step, progress, elapsed = int(about["step"]), float(about["progress"]), float(about["elapsed"])
    whose = hashlib.sha256(data).hexdigest(), len(data)
    tensors, packed = load(data), None
    if "packed" in about:
        packed = {name: tensor.nbytes for name, tensor in tensors.items()}
        tensors = unpack(tensors, about["packed"], path)
    state = dict(about["state"])
    checkpoint = Checkpoint(step, progress, elapsed, tensors, state, *whose, packed)
    return checkpoint, int(about["schema"])


def save_packed(
    root: Path, tensors: Mapping[str, Tensor], described: Mapping[str, Any], step: int, p: float
) -> Path:
    """Write a packed model as the only checkpoint of a run folder, see ``runs.packing``.

    Raises:
        DataError: it cannot be written.
    """
    about = {"schema": SCHEMA, "step": step, "progress": p, "elapsed": 0.0, "state": {}}
    about["packed"] = described
    with replacing(root / LAST) as beside, written_apart(beside) as own:
        save_file(dict(tensors), own, metadata={"gsdmsr": json.dumps(about)})
    return root / LAST


def _metadata(data: bytes) -> dict[str, str]:
    """Return what the header of a safetensors file says beside its tensors."""
    length = int.from_bytes(data[:8], "little")
    return dict(json.loads(data[8 : 8 + length])["__metadata__"])
