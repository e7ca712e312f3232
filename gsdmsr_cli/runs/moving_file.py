"""Reads a ``.dsplat`` file in place of a run: what it was made of, and the model that plays it."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.model import MOTION, STORED_AS, Model
from gsdmsr_cli.moving.container import SUFFIX, WRONG, from_bytes
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.runs.checkpoints import Checkpoint

RESULTS = "{name}.results"
"""The folder beside a file for what ``eval`` and ``render`` make of it."""

_OF_SPLATS = {"means", "quats", "log_scales", "opacities", "sh_0", "sh_rest"}


def is_moving_file(path: Path) -> bool:
    """Return whether a path names a file of moving splats, by its name."""
    return path.suffix.lower() == SUFFIX and path.is_file()


def results_of(path: Path) -> Path:
    """Return the folder for results of a file."""
    return path.with_name(RESULTS.format(name=path.name))


def about(path: Path) -> dict[str, Any]:
    """Return what a file says of the run that it was made of, as in a run's description.

    Raises:
        DataError: it cannot be read, or says nothing of that.
    """
    header, _ = _parts(path, bytes_of(path))
    found = header.get("about")
    if not isinstance(found, dict) or "preset" not in found:
        raise DataError(f"{path}: does not say which run it is of; only players can show it")
    return found


def load(path: Path) -> tuple[Model, Checkpoint]:
    """Return the model that plays a file, and what stands for a checkpoint.

    Raises:
        DataError: the file cannot be read, or is damaged.
    """
    data = bytes_of(path)
    header, parts = _parts(path, data)
    try:
        model = model_of(decoded(header, parts))
        told = header["about"]
        step, progress = int(told["step"]), float(told["progress"])
    except WRONG as error:
        raise DataError(f"{path}: damaged: {error}; export it again") from error
    sizes = {_stored_as(name): len(part.stream) for name, part in parts.items()}
    sizes[f"{MOTION}.header"] = len(data) - sum(sizes.values())
    whose = hashlib.sha256(data).hexdigest(), len(data)
    return model, Checkpoint(step, progress, 0.0, model.tensors(), {}, *whose, sizes)


def _stored_as(name: str) -> str:
    """Return under which name of a checkpoint the bytes of a part are counted."""
    return f"{STORED_AS}{name}" if name in _OF_SPLATS else f"{MOTION}.{name}"


def bytes_of(path: Path) -> bytes:
    """Return what a file holds.

    Raises:
        DataError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def _parts(path: Path, data: bytes) -> tuple[dict[str, Any], Any]:
    try:
        return from_bytes(data)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
