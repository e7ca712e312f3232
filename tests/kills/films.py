"""A run to be drawn, and what must hold of the films that are drawn of it, at every moment."""

from __future__ import annotations

import json
from pathlib import Path

from training_checks import begun_run

from gsdmsr_cli.ground.files import leftovers
from gsdmsr_cli.scene.imaging import read_exr, read_image
from gsdmsr_cli.scene.native import load_av

Shown = dict[str, object]

FRAMES = 6
FILM = "--path", "orbit", "--frames", str(FRAMES), "--output", "rgb,depth"

_FEW = ("splats.count=200", "splats.start=box", "splats.opacity=0.5", "motion={name: static}")


def make_run(data: Path, folder: Path) -> Path:
    """Make a run that has made no step, and return its folder."""
    return begun_run(data, folder, _FEW).root


def shown(folder: Path) -> Shown:
    """Return what all files of films show, by their names, which say what is whole.

    Raises:
        DataError, ValueError, OSError: one is not.
    """
    unfinished = {path for inside in _folders(folder) for path in leftovers(inside)}
    found = {path for path in folder.rglob("*") if path.is_file()} - unfinished
    return {path.relative_to(folder).as_posix(): _shown(path) for path in sorted(found)}


def _folders(folder: Path) -> list[Path]:
    return [path for path in (folder, *folder.rglob("*")) if path.is_dir()]


def _shown(path: Path) -> object:
    if path.suffix == ".json":
        return json.loads(path.read_text(encoding="utf-8"))
    if path.suffix == ".exr":  # which also holds when it was written
        return read_exr(path)[0].tobytes()
    if path.suffix == ".webm":
        with load_av().open(str(path)) as video:
            return sum(1 for _ in video.decode(video=0))
    return read_image(path).shape, path.read_bytes()


def names(folder: Path) -> list[str]:
    """Return all that lies in a folder, in whatever state."""
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))
