"""Reads D-NeRF's layout: ``transforms_{train,val,test}.json``, a time for each frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _transforms as transforms
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.scene import SPLITS, Scene, View

SIGN = "transforms_train.json"

PRESET = "dnerf"

BOUND = 1.3
"""Half edge of the box in which D-NeRF's objects stand (METHODS 0.8) [world units]."""


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds the JSON file of any split."""
    return any(path.is_file() for path in _paths(folder).values())


def read(folder: Path) -> Scene:
    """Read a folder in D-NeRF's layout; the val and test splits may be missing.

    Also read: instant-ngp's intrinsics (``fl_x`` ...), of all frames or of one, and NVFi's "Dynamic
    Object" files, where ``data`` holds one entry per camera and that its ``frames``.

    Raises:
        DataError: something in it cannot be used; the message names the file and frame.
    """
    paths = {split: path for split, path in _paths(folder).items() if path.is_file()}
    if "train" not in paths:
        found = ", ".join(path.name for path in paths.values()) or "none of its kind"
        raise DataError(f"{folder}: no transforms_train.json; found {found}")
    views = [view for split, path in paths.items() for view in _read_split(folder, split, path)]
    if not any(view.split == "train" for view in views):
        raise DataError(f"{paths['train']}: no train frames; at least one is needed")
    checks.one_size(views)
    return Scene(
        root=folder,
        layout="dnerf",
        views=tuple(views),
        points=np.zeros((0, 3), np.float32),
        colours=None,
        duration=None,
        bound=BOUND,
        fingerprint=checks.fingerprint(paths.values()),
    )


def _paths(folder: Path) -> dict[str, Path]:
    return {split: folder / f"transforms_{split}.json" for split in SPLITS}


def _read_split(folder: Path, split: str, path: Path) -> list[View]:
    views = [
        _read_view(folder, split, fields, where)
        for where, fields in _frames(checks.read_json(path), str(path))
    ]
    names = checks.unique_names(view.name for view in views)
    return [replace(view, name=name) for view, name in zip(views, names, strict=True)]


def _frames(document: dict[str, Any], where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every frame's place in the file and its fields.

    A frame inherits what it does not say itself from its camera's entry and from the top level.
    """
    shared = {k: v for k, v in document.items() if k in transforms.CAMERA_KEYS}
    if "frames" in document:
        listed = checks.sequence(document["frames"], f"{where}: frames")
        entries = [(f"frame {i}", entry) for i, entry in enumerate(listed)]
    elif "data" in document:
        cameras = checks.mapping(document["data"], f"{where}: data")
        entries = [(f"camera '{name}'", entry) for name, entry in cameras.items()]
    else:
        raise DataError(f"{where}: neither 'frames' nor 'data' in it")
    for label, entry in entries:
        place = f"{where}: {label}"
        fields = shared | checks.mapping(entry, place)
        if "frames" in fields:
            yield from _camera_frames(fields, place)
        else:
            yield place, fields


def _camera_frames(camera: dict[str, Any], where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the frames of one camera's entry.

    As in NVFi's loader, a camera whose frames have no time was sampled evenly from 0 to 1.
    """
    listed = checks.sequence(camera["frames"], f"{where}: frames")
    frames = [checks.mapping(f, f"{where}, frame {i}") for i, f in enumerate(listed)]
    timed = "time" in camera or len(frames) < 2 or any("time" in frame for frame in frames)
    shared = {key: value for key, value in camera.items() if key != "frames"}
    for i, frame in enumerate(frames):
        time = {} if timed else {"time": i / (len(frames) - 1)}
        yield f"{where}, frame {i}", shared | time | frame


def _read_view(folder: Path, split: str, fields: dict[str, Any], where: str) -> View:
    where = transforms.require(fields, where)
    if "time" not in fields:
        raise DataError(f"{where}: no 'time'; every frame of a moving scene needs one in [0, 1]")
    time = checks.unit_time(fields["time"], f"{where}: time")
    return transforms.read_view(folder, split, time, fields, where)
