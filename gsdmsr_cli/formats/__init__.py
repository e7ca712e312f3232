"""Reads data sets: one module per layout of files."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from gsdmsr_cli.formats._decoded import kept_frames
from gsdmsr_cli.formats._suited import Suited, suited_preset
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.printing import printable
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.scene import Scene

__all__ = [
    "Suited",
    "kept_frames",
    "layout_of",
    "needs_preparing",
    "read_scene",
    "recognised",
    "suited_preset",
]


def read_scene(
    folder: Path,
    on_progress: OnProgress = lambda done, total: None,
    decoded: Path | None = None,
) -> Scene:
    """Read a data folder with the first format that recognises it.

    A format is a module of this package with ``SIGN: str``, the files that it is recognised by, for
    messages; ``matches(folder: Path) -> bool``; and ``read(folder: Path) -> Scene``, which raises
    DataError. It may have ``prepare(folder: Path, place: Path, on_progress: OnProgress)``, which
    writes into the folder ``place`` what is needed only once, such as the frames of videos, with
    ``is_prepared(folder: Path) -> bool`` and ``place_of(folder: Path) -> Path``, which says where
    that is; its ``read`` is given the place too. And it may have ``PRESET``, the preset for its
    scenes where none is named, if their cameras do not tell.

    Args:
        folder: of the capture.
        on_progress: called with the progress of ``prepare``, where a format has one.
        decoded: where ``prepare`` writes, if not where the format says.

    Raises:
        DataError: there is no such folder, no format recognises it, or its content is unusable.
    """
    if not folder.is_dir():
        problem = "is a file, not a folder" if folder.exists() else "does not exist"
        raise DataError(f"data folder {folder} {problem}; give the folder of a capture")
    try:
        return _read(folder, on_progress, decoded)
    except OSError as error:
        raise DataError(f"data folder {folder} cannot be read: {error}") from error


def recognised(folder: Path) -> bool:
    """Return whether the folder has a layout that ``read_scene`` knows."""
    return layout_of(folder) is not None


def layout_of(folder: Path) -> str | None:
    """Return the name of the format that ``read_scene`` would read the folder with, or None."""
    names = plugins.names(__name__) if folder.is_dir() else []
    return next((n for n in names if plugins.load(__name__, n).matches(folder)), None)


def needs_preparing(folder: Path) -> bool:
    """Return whether ``read_scene`` would decode what is in a folder of known layout."""
    layout = layout_of(folder)
    if layout is None:
        return False
    module = plugins.load(__name__, layout)
    return hasattr(module, "prepare") and not module.is_prepared(folder)


def _read(folder: Path, on_progress: OnProgress, decoded: Path | None) -> Scene:
    formats = [(name, plugins.load(__name__, name)) for name in plugins.names(__name__)]
    for _, module in formats:
        if module.matches(folder):
            scene = _prepared(module, folder, on_progress, decoded)
            views = tuple(replace(view, name=printable(view.name)) for view in scene.views)
            return replace(scene, views=views)
    known = "; ".join(f"{name} ({module.SIGN})" for name, module in formats)
    raise DataError(
        f"data folder {folder} has no known layout; found {_listing(folder)}; known: {known}"
    )


def _prepared(module: Any, folder: Path, on_progress: OnProgress, decoded: Path | None) -> Scene:
    """Return the scene that a format reads, after what it needs only once."""
    place: tuple[Path, ...] = ()
    if hasattr(module, "prepare"):
        place = (decoded or module.place_of(folder),)
        module.prepare(folder, *place, on_progress)
    scene: Scene = module.read(folder, *place)
    return scene


def _listing(folder: Path) -> str:
    entries = sorted(islice((entry.name for entry in folder.iterdir()), 1000))
    shown = ", ".join(entries[:5]) or "nothing"
    return f"{shown} and more" if len(entries) > 5 else shown
