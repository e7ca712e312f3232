"""Reads PanopticSports of Dynamic 3D Gaussians: ``train_meta.json``, ``ims`` and ``seg``.

Facts: Luiten et al. 2024 and the loader of their code: ``k``, ``w2c`` and ``fn`` are lists by
moment, then by camera; ``init_pt_cld.npz`` holds x y z, r g b and whether a point moves.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _points, _world
from gsdmsr_cli.formats._arrays import read_npz
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.scene import MOVING, Scene, View

SIGN = "train_meta.json"

_SPLITS = ("train", "test")


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds the cameras of the train split."""
    return (folder / SIGN).is_file()


def read(folder: Path) -> Scene:
    """Read a scene of PanopticSports; the test split may be missing.

    Raises:
        DataError: something in it cannot be used; the message names the file and frame.
    """
    paths = [folder / f"{split}_meta.json" for split in _SPLITS]
    views = [
        view
        for split, path in zip(_SPLITS, paths, strict=True)
        if path.is_file()
        for view in _read_split(folder, split, path)
    ]
    if not any(view.split == "train" for view in views):
        raise DataError(f"{paths[0]}: no train frames; at least one is needed")
    checks.one_size(views)
    points, colours = _read_points(folder / "init_pt_cld.npz")
    world = _world.normalize([view for view in views if view.time == 0], points)
    return Scene(
        root=folder,
        layout="panoptic",
        views=world.views(views),
        points=world.points(points),
        colours=colours,
        duration=None,
        bound=world.bound,
        fingerprint=checks.fingerprint(path for path in paths if path.is_file()),
    )


def _read_split(folder: Path, split: str, path: Path) -> list[View]:
    document = checks.read_json(path)
    size = tuple(checks.pixels(document.get(key), f"{path}: {key}") for key in "wh")
    columns = [checks.sequence(document.get(key), f"{path}: {key}") for key in ("fn", "k", "w2c")]
    if len({len(column) for column in columns}) != 1:
        raise DataError(f"{path}: fn, k and w2c have different lengths; each needs every moment")
    moments = len(columns[0])
    views = []
    for t, at_once in enumerate(zip(*columns, strict=True)):
        lists = [checks.sequence(entry, f"{path}: moment {t}") for entry in at_once]
        if len({len(entry) for entry in lists}) != 1:
            raise DataError(f"{path}: moment {t}: fn, k and w2c have different numbers of cameras")
        for c, (name, matrix, pose) in enumerate(zip(*lists, strict=True)):
            where = f"{path}: moment {t}, camera {c}"
            time = t / max(moments - 1, 1)
            views.append(_read_view(folder, split, time, name, matrix, pose, size, where))
    return views


def _read_view(
    folder: Path, split: str, time: float, name: Any, matrix: Any, pose: Any, size: Any, where: str
) -> View:
    image = checks.picture_path(folder / "ims", name, f"{where}: fn", within=folder)
    rows = [checks.numbers(row, 3, f"{where}: k") for row in checks.sequence(matrix, f"{where}: k")]
    if len(rows) != 3:
        raise DataError(f"{where}: k is not 3 x 3 numbers")
    camera = Camera(
        world_to_camera=checks.rigid_pose(pose, f"{where}: w2c"),
        fx=checks.positive(rows[0][0], f"{where}: k: focal length"),
        fy=checks.positive(rows[1][1], f"{where}: k: focal length"),
        cx=rows[0][2],
        cy=rows[1][2],
        width=size[0],
        height=size[1],
    )
    found = image_size(image)
    checks.same_shape(size, found, image)
    view = View(
        name=str(PurePosixPath(name).with_suffix("")).replace("/", "_"),
        camera=camera.resized(*found),
        time=time,
        split=split,
        image_path=image,
    )
    mask_name = str(PurePosixPath(name).with_suffix(".png"))
    mask = checks.path_if_there(folder / "seg", mask_name, f"{where}: fn", within=folder)
    if mask is None:
        return view
    checks.mask_size(mask, image_size(mask), view)
    return replace(view, signals={MOVING: mask})


def _read_points(path: Path) -> _points.Points:
    if not path.is_file():
        return _points.none()
    table = read_npz(path, "data")
    if table.ndim != 2 or table.shape[1] < 6:
        raise DataError(f"{path}: its data has shape {table.shape}; it must be (P, 6) or wider")
    table = table[np.isfinite(table).all(axis=1)]
    return table[:, :3], table[:, 3:6].astype(np.float32)
