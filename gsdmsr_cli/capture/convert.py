"""Writes a published data set, in any supported layout, as a scene folder."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.capture import write
from gsdmsr_cli.capture.versions import versions
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.imaging import read_image, write_png
from gsdmsr_cli.scene.scene import MASK, MOVING, Scene, View

FOLDERS = {MASK: "counted", MOVING: "masks"}
"""Where the files of each signal are written."""

GREY = 0.5
"""Colour of points that have none."""


def write_converted(folder: Path, scene: Scene, on_progress: OnProgress) -> None:
    """Write a scene that has been read, whose world is normalised, into ``folder``.

    Pictures are copied as they are, or linked if they have been decoded for this; those taken
    through a lens are undistorted.

    Raises:
        DataError: a picture cannot be read or written.
    """
    views = []
    for done, view in enumerate(scene.views, start=1):
        views.append(_placed(folder, view, scene))
        on_progress(done, len(scene.views))
    write.write_transforms(folder / "transforms.json", views, write.POINTS)
    colours = np.full(scene.points.shape, GREY) if scene.colours is None else scene.colours
    levels = np.rint(colours * 255).clip(0, 255).astype(np.uint8)
    write.write_points(folder / write.POINTS, scene.points.astype(np.float64), levels)
    provenance: dict[str, Any] = {
        "input": {"name": scene.root.name, "kind": scene.layout, "sha256": scene.fingerprint},
        "versions": versions(),
    }
    note = folder / write.NOTE
    write.write_note(note, scene.bound, scene.duration, provenance, None)


def _placed(folder: Path, view: View, scene: Scene) -> View:
    """Write the view's pictures below ``folder``; return it with them, as a pinhole's."""
    name = f"{view.split}_{view.name}"
    image = _written(folder, Path("images") / name, view, view.image_path, scene)
    signals = {
        signal: _written(folder, Path(FOLDERS[signal]) / name, view, path, scene)
        for signal, path in view.signals.items()
    }
    return replace(view, image_path=image, signals=signals, lens=None)


def _written(folder: Path, place: Path, view: View, path: Path, scene: Scene) -> Path:
    """Write the picture at ``path`` to a place below ``folder``; return it with its suffix."""
    target = place.with_name(f"{place.name}{path.suffix if view.lens is None else '.png'}")
    (folder / target).parent.mkdir(exist_ok=True)
    if view.lens is not None:
        write_png(folder / target, write.undistorted(read_image(path), view.lens))
        return target
    own = scene.decoded is not None and path.is_relative_to(scene.decoded)
    try:
        if not (own and _linked(path, folder / target)):
            shutil.copyfile(path, folder / target)
    except FileNotFoundError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error
    return target


def _linked(path: Path, target: Path) -> bool:
    """Return whether a file could be given a second name, as some drives do not let one do."""
    try:
        target.hardlink_to(path)
    except OSError:
        return False
    return True
