"""Begins run folders, and goes on with them: refuses those in use, and clears those replaced."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import can_be_written, leftovers, nearest_there, remove_leftovers
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.runs import checkpoints, moments, seen_pictures, segments
from gsdmsr_cli.runs.run import OWN, Run, is_run
from gsdmsr_cli.scene.picture_hashes import digest
from gsdmsr_cli.scene.scene import Scene


def refuse_used(root: Path, overwrite: bool) -> None:
    """Raise DataError unless a run may be started in the folder ``root``."""
    if not root.exists():
        _require_place(root)
        return
    if root.is_dir() and set(root.iterdir()) <= {*leftovers(root)}:
        return  # it is empty but for what a training that was killed at its start has left
    if not is_run(root):
        raise DataError(f"{root}: exists and is not a run folder; choose another --out")
    if not overwrite:
        raise DataError(
            f"{root}: holds a run; continue it with --resume or replace it with --overwrite"
        )


def require_apart(root: Path, scene: Scene) -> None:
    """Raise DataError if the scene lies in the folder ``root``, which a run would replace."""
    if scene.root.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{root}: holds the data {scene.root}; choose another --out")


def create_run(
    root: Path,
    name: str,
    preset: Preset,
    facts: Facts,
    scene: Scene,
    overwrite: bool = False,
    reason: str | None = None,
    verify: bool = False,
) -> Run:
    """Start a run folder; an earlier run there is deleted if ``overwrite`` says so.

    ``reason`` is which preset the data has called for, and why; ``verify`` says whether hashes of
    whole pictures are wanted beside those of samples.

    Raises:
        DataError: the folder is in use and ``overwrite`` is not set, or is not a run at all, or
            holds the scene, or cannot be written.
    """
    refuse_used(root, overwrite)
    require_apart(root, scene)
    data = scene.root.resolve()
    if root.exists():
        _clear(root)
    run = Run(root, name, preset, facts, data, scene.layout, scene.fingerprint, reason)
    run = replace(run, pictures=digest(scene.pictures))
    run.describe()
    seen_pictures.remember(root, scene, verify)
    return run


def continue_run(run: Run, preset: Preset, scene: Scene) -> Run:
    """Return the run with other options, and with its scene at another place; both written down.

    ``scene`` is what the run sees of it, see ``Run.part_of``.

    Raises:
        DataError: the scene is not the run's, or the folder cannot be written.
    """
    run.check_part(scene)
    remove_leftovers(run.root)  # a killed training was writing them
    continued = replace(run, preset=preset, data=scene.root.resolve())
    continued.describe()
    return continued


def _clear(root: Path) -> None:
    """Remove what a training wrote into its folder, and nothing else.

    Its description stays until it is replaced: a folder without one would be nobody's.
    """
    remove_leftovers(root)
    moments.rewind(root, 0)
    segments.remove(root)
    checkpoints.remove(root)
    for name in OWN:
        (root / name).unlink(missing_ok=True)


def _require_place(root: Path) -> None:
    """Raise DataError unless the folder ``root``, which is not there yet, can be made."""
    nearest = nearest_there(root)
    if not can_be_written(root):
        problem = "cannot be written" if nearest.is_dir() else "is a file"
        raise DataError(f"{root}: cannot be made, since {nearest} {problem}; choose another --out")
