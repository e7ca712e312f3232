"""A published data set, in any layout that is read, as a scene folder."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.capture import write
from gsdmsr_cli.capture.versions import versions
from gsdmsr_cli.errors import DataError
from gsdmsr_cli.imaging import read_image, write_png
from gsdmsr_cli.scene import Scene, View

POINTS = "points.ply"

GREY = 0.5
"""Colour of points that have none."""


def write_converted(folder: Path, scene: Scene, tell: Callable[[int, int], None]) -> None:
    """Write a scene that has been read, whose world is settled, into ``folder``.

    Pictures are copied as they are; those taken through a lens are undistorted.

    Raises:
        DataError: a picture cannot be read or written.
    """
    views = []
    for done, view in enumerate(scene.views, start=1):
        views.append(_placed(folder, view))
        tell(done, len(scene.views))
    write.write_transforms(folder / "transforms.json", views, POINTS)
    colours = np.full(scene.points.shape, GREY) if scene.colours is None else scene.colours
    levels = np.rint(colours * 255).clip(0, 255).astype(np.uint8)
    write.write_points(folder / POINTS, scene.points.astype(np.float64), levels)
    provenance: dict[str, Any] = {
        "input": {"name": scene.root.name, "kind": scene.layout, "sha256": scene.fingerprint},
        "versions": versions(),
    }
    note = folder / write.NOTE
    write.write_note(note, scene.bound, scene.duration, provenance, None)


def _placed(folder: Path, view: View) -> View:
    """Write the view's pictures below ``folder``; return it with them, as a pinhole's."""
    name = f"{view.split}_{view.name}"
    image = _written(folder, Path("images") / name, view, view.image_path)
    mask = view.mask_path and _written(folder, Path("counted") / name, view, view.mask_path)
    moving = view.moving_path and _written(folder, Path("masks") / name, view, view.moving_path)
    return replace(view, image_path=image, mask_path=mask, moving_path=moving, lens=None)


def _written(folder: Path, place: Path, view: View, path: Path) -> Path:
    """Write the picture at ``path`` to a place below ``folder``; return it with its suffix."""
    target = place.with_name(f"{place.name}{path.suffix if view.lens is None else '.png'}")
    (folder / target).parent.mkdir(exist_ok=True)
    if view.lens is not None:
        write_png(folder / target, write.undistorted(read_image(path), view.lens))
        return target
    try:
        shutil.copyfile(path, folder / target)
    except FileNotFoundError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    return target
