"""Reads nerfstudio's layout and the scene folders of ``gsdmsr prepare``: ``transforms.json``.

Facts: nerfstudio's documentation of its data conventions. Beside them, a frame may have a ``time``
and a ``motion_mask_path``, white where something moves.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _points, _world
from gsdmsr_cli.formats import _transforms as transforms
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.scene import MASK, MOVING, SPLITS, Scene, View

SIGN = "transforms.json"

DECLARED_BY = "scene.json"
"""Written by ``gsdmsr prepare``: the world is normalised already, and this file gives its bound."""

MASK_KEYS = {MASK: "mask_path", MOVING: "motion_mask_path"}
"""Name of a signal to the key of a frame that names its file."""

TEST_EVERY = 8
"""Without lists of frames every 8th, from the first on, is for testing."""


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds one JSON file of all frames, and none per split."""
    return (folder / SIGN).is_file() and not (folder / "transforms_train.json").is_file()


def read(folder: Path) -> Scene:
    """Read a folder in nerfstudio's layout.

    Raises:
        DataError: something in it cannot be used; the message names the file and frame.
    """
    path = folder / SIGN
    document = checks.read_json(path)
    frames = _frames(document, path)
    times = _times(frames)
    splits = _splits(document, [_name(fields, where) for where, fields in frames], path)
    views = [
        _read_view(folder, split, time, fields, where)
        for (where, fields), time, split in zip(frames, times, splits, strict=True)
        if split is not None
    ]
    if not any(view.split == "train" for view in views):
        raise DataError(f"{path}: no train frames; at least one is needed")
    checks.one_size(views)
    names = checks.unique_names(view.name for view in views)
    views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
    points, colours = _read_points(folder, document, path)
    bound, duration, origin = _declared(folder / DECLARED_BY)
    world = _world.normalize(views, points) if bound is None else _world.as_it_is(bound)
    return Scene(
        root=folder,
        layout="nerfstudio",
        views=world.views(views),
        points=world.points(points),
        colours=colours,
        duration=duration,
        bound=world.bound,
        fingerprint=checks.fingerprint([path]),
        origin=origin,
    )


def _frames(document: dict[str, Any], path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return every frame's place in the file and its fields, with those of the top level."""
    shared = {k: v for k, v in document.items() if k in transforms.CAMERA_KEYS}
    listed = checks.sequence(document.get("frames"), f"{path}: frames")
    frames = []
    for i, entry in enumerate(listed):
        fields = shared | checks.mapping(entry, f"{path}: frame {i}")
        frames.append((transforms.require(fields, f"{path}: frame {i}"), fields))
    return frames


def _times(frames: list[tuple[str, dict[str, Any]]]) -> list[float]:
    """Return the times; where no frame has one, they were taken evenly in the file's order."""
    if not any("time" in fields for _, fields in frames):
        return [i / max(len(frames) - 1, 1) for i in range(len(frames))]
    return [checks.unit_time(fields.get("time"), f"{where}: time") for where, fields in frames]


def _name(fields: dict[str, Any], where: str) -> str:
    name = fields["file_path"]
    if not isinstance(name, str):
        raise DataError(f"{where}: file_path is {checks.shown(name)}; it must name a file")
    return name


def _splits(document: dict[str, Any], names: list[str], path: Path) -> list[str | None]:
    """Return the split of every frame, None for those that are left out."""
    keys = {f"{split}_filenames": split for split in SPLITS}
    if not keys.keys() & document.keys():
        alone = len(names) < 2
        return ["train" if alone or i % TEST_EVERY else "test" for i in range(len(names))]
    found: dict[str, str] = {}
    for key, split in keys.items():
        for name in checks.sequence(document.get(key, []), f"{path}: {key}"):
            if not isinstance(name, str) or name not in names:
                raise DataError(f"{path}: {key}: {checks.shown(name)} is the file_path of no frame")
            found.setdefault(name, split)
    return [found.get(name) for name in names]


def _read_view(folder: Path, split: str, time: float, fields: dict[str, Any], where: str) -> View:
    view = transforms.read_view(folder, split, time, fields, where)
    given = {name: key for name, key in MASK_KEYS.items() if fields.get(key) is not None}
    masks = {name: _mask(folder, fields, key, view, where) for name, key in given.items()}
    return replace(view, signals=masks)


def _mask(folder: Path, fields: dict[str, Any], key: str, view: View, where: str) -> Path:
    mask = checks.picture_path(folder, fields[key], f"{where}: {key}")
    checks.mask_size(mask, image_size(mask), view)
    return mask


def _read_points(folder: Path, document: dict[str, Any], path: Path) -> _points.Points:
    name = document.get("ply_file_path")
    if name is None:
        return _points.none()
    return _points.read_ply(checks.inner_path(folder, name, f"{path}: ply_file_path"))


def _declared(path: Path) -> tuple[float | None, float | None, str | None]:
    """Return bound, duration [s] and origin of a scene that ``gsdmsr prepare`` has normalised."""
    if not path.is_file():
        return None, None, None
    document = checks.read_json(path)
    if "gsdmsr" not in document:
        return None, None, None
    duration, given = document.get("duration"), document.get("input")
    origin = given.get("kind") if isinstance(given, dict) else None
    return (
        checks.positive(document.get("bound"), f"{path}: bound"),
        None if duration is None else checks.number(duration, f"{path}: duration"),
        origin if isinstance(origin, str) else None,
    )
