"""Reads Nerfies and HyperNeRF: ``dataset.json``, ``metadata.json``, ``camera/``, ``rgb/``.

Facts: google/nerfies and google/hypernerf (Park et al. 2021), whose cameras are OpenCV's with
Brown's distortion; splits and times as TiNeuVox and Deformable-3DGS read them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _points, _world
from gsdmsr_cli.formats._arrays import read_npy
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.scene import Scene, View

SIGN = "dataset.json and camera/"

PRESET = "nerfies"

SCALES = ("2x", "1x", "4x", "8x")
"""Folders of pictures below ``rgb``, the first that is there; papers measure on 2x."""

TRAIN_EVERY, TEST_AFTER = 4, 2
"""Without a list of test frames every 4th trains, and those half way between are for testing."""


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds the list of frames and a folder of cameras."""
    return (folder / "dataset.json").is_file() and (folder / "camera").is_dir()


def read(folder: Path) -> Scene:
    """Read a capture of Nerfies or HyperNeRF.

    ``val_ids`` are the test split: nothing is chosen by them. The world is normalised;
    of ``scene.json`` only the depths are used.

    Raises:
        DataError: something in it cannot be used; the message names the file and frame.
    """
    ids, splits = _splits(folder / "dataset.json")
    times = _times(folder / "metadata.json", ids)
    pictures = _picture_folder(folder)
    views = [
        _read_view(folder, pictures, name, times[name], split) for name, split in splits.items()
    ]
    checks.one_size(views)
    points, colours = _read_points(folder / "points.npy")
    world = _world.normalize(views, points, _depths(folder / "scene.json"))
    files = [folder / name for name in ("dataset.json", "metadata.json", "scene.json")]
    cameras = [folder / _camera(name) for name in splits]
    return Scene(
        root=folder,
        layout="nerfies",
        views=world.views(views),
        points=world.points(points),
        colours=colours,
        duration=None,
        bound=world.bound,
        fingerprint=checks.fingerprint(path for path in [*files, *cameras] if path.is_file()),
    )


def _splits(path: Path) -> tuple[list[str], dict[str, str]]:
    """Return all frames, and the split of each that belongs to one."""
    document = checks.read_json(path)
    ids = _names(document, "ids", path)
    for key in ("train_ids", "val_ids"):
        strangers = sorted(set(_names(document, key, path)) - set(ids))
        if strangers:
            raise DataError(f"{path}: {key}: '{strangers[0]:.60}' is not among its ids")
    train, test = _names(document, "train_ids", path), _names(document, "val_ids", path)
    if not test:
        train = ids[::TRAIN_EVERY]
        test = ids[TEST_AFTER::TRAIN_EVERY][: len(train) - 1]
    if not train:
        raise DataError(f"{path}: no train frames; at least one is needed")
    return ids, dict.fromkeys(train, "train") | dict.fromkeys(test, "test")


def _names(document: dict[str, Any], key: str, path: Path) -> list[str]:
    names = checks.sequence(document.get(key, []), f"{path}: {key}")
    for name in names:
        if not isinstance(name, str):
            found = checks.shown(name)
            raise DataError(f"{path}: {key}: {found} found where a frame's name must stand")
    return names


def _times(path: Path, ids: list[str]) -> dict[str, float]:
    """Return the time of every frame: its ``time_id``, else its ``warp_id``, by the largest."""
    document = checks.read_json(path)
    moments = {}
    for name in ids:
        where = f"{path}: '{name:.60}'"
        if name not in document:
            raise DataError(f"{where} is missing; every frame needs an entry")
        entry = checks.mapping(document[name], where)
        key = "time_id" if "time_id" in entry else "warp_id"
        moments[name] = checks.number(entry.get(key), f"{where}: {key}")
        if moments[name] < 0:
            raise DataError(f"{where}: {key} is {moments[name]:g}; it must be 0 or more")
    last = max(moments.values(), default=0.0) or 1.0
    return {name: moment / last for name, moment in moments.items()}


def _picture_folder(folder: Path) -> str:
    for scale in SCALES:
        if (folder / "rgb" / scale).is_dir():
            return f"rgb/{scale}"
    raise DataError(f"{folder}: no pictures; looked for {', '.join(f'rgb/{s}' for s in SCALES)}")


def _camera(name: str) -> str:
    return f"camera/{name}.json"


def _read_view(folder: Path, pictures: str, name: str, time: float, split: str) -> View:
    path = checks.inner_path(folder, _camera(name), f"{folder}: frame '{name:.60}'")
    image_path = checks.picture_path(folder, f"{pictures}/{name}", f"{path}: frame '{name:.60}'")
    fields = checks.read_json(path)
    lens = _lens(fields, path)
    width, height = image_size(image_path)
    checks.same_shape((lens.width, lens.height), (width, height), image_path)
    lens = lens.resized(width, height)
    return View(
        name=name,
        camera=lens.camera(_world_to_camera(fields, path)),
        time=time,
        split=split,
        image_path=image_path,
        lens=None if lens.is_pinhole else lens,
    )


def _lens(fields: dict[str, Any], path: Path) -> Lens:
    focal = checks.positive(fields.get("focal_length"), f"{path}: focal_length")
    aspect = checks.positive(fields.get("pixel_aspect_ratio", 1), f"{path}: pixel_aspect_ratio")
    size = checks.numbers(fields.get("image_size"), 2, f"{path}: image_size")
    width, height = (checks.pixels(value, f"{path}: image_size") for value in size)
    cx, cy = checks.numbers(fields.get("principal_point"), 2, f"{path}: principal_point")
    radial = checks.numbers(
        fields.get("radial_distortion", [0] * 3), 3, f"{path}: radial_distortion"
    )
    key = "tangential_distortion" if "tangential_distortion" in fields else "tangential"
    p1, p2 = checks.numbers(fields.get(key, [0] * 2), 2, f"{path}: {key}")
    return Lens(
        fx=focal,
        fy=focal * aspect,
        cx=cx,
        cy=cy,
        width=width,
        height=height,
        radial=tuple(radial),
        tangential=(p1, p2),
        skew=checks.number(fields.get("skew", 0), f"{path}: skew"),
    )


def _world_to_camera(fields: dict[str, Any], path: Path) -> NDArray[np.float64]:
    """Return the pose, from ``orientation``, world to camera in OpenCV axes, and ``position``."""
    rows = checks.sequence(fields.get("orientation"), f"{path}: orientation")
    position = checks.numbers(fields.get("position"), 3, f"{path}: position")
    square = [[*checks.numbers(row, 3, f"{path}: orientation"), 0.0] for row in rows]
    pose = checks.rigid_pose([*square, [0.0, 0.0, 0.0, 1.0]], f"{path}: orientation")
    pose[:3, 3] = -pose[:3, :3] @ position
    return pose


def _read_points(path: Path) -> _points.Points:
    """Return the points of the capture, none if there is no such file."""
    if not path.is_file():
        return _points.none()
    points = read_npy(path)
    if points.ndim != 2 or points.shape[1] != 3:
        raise DataError(f"{path}: has shape {points.shape}; it must hold (P, 3) numbers")
    return _points.uncoloured(points)


def _depths(path: Path) -> tuple[float, float] | None:
    """Return the nearest and farthest depth in the capture's own units, if it gives them."""
    if not path.is_file():
        return None
    document = checks.read_json(path)
    if not {"near", "far", "scale"} <= document.keys():
        return None
    near, far, scale = (
        checks.positive(document[key], f"{path}: {key}") for key in ("near", "far", "scale")
    )
    return near / scale, far / scale
