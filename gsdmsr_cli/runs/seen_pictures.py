"""What a run remembers of the pictures that it was trained on, to tell when they have changed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsdmsr_cli import __version__
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.scene import picture_hashes
from gsdmsr_cli.scene.picture_hashes import Hashes
from gsdmsr_cli.scene.scene import Scene

PICTURES = "pictures.json"
"""File in a run folder with a hash of every picture: of a sample, and of the whole if asked for."""

SAMPLED, WHOLE = "sampled", "whole"


def remember(root: Path, scene: Scene, whole: bool) -> None:
    """Write the hashes of a scene's pictures.

    Raises:
        DataError: a picture cannot be read, or the file not be written.
    """
    hashes: dict[str, Any] = {SAMPLED: scene.pictures}
    if whole:
        hashes[WHOLE] = picture_hashes.whole(scene.root, scene.files, scene.decoded)
    write_json(root / PICTURES, {"gsdmsr": __version__, **hashes})


def check(root: Path, expected: str | None, scene: Scene) -> None:
    """Raise DataError if samples of a scene's pictures have another hash than in training.

    Runs of earlier versions remember none: ``expected`` is None, and nothing is checked.
    """
    if expected is not None and picture_hashes.digest(scene.pictures) != expected:
        remembered = _remembered(root).get(SAMPLED, {})
        _refuse(root, scene, picture_hashes.difference(scene.pictures, remembered))


def check_whole(root: Path, scene: Scene) -> None:
    """Raise DataError unless every byte of a scene's pictures is as it was in training."""
    remembered = _remembered(root).get(WHOLE)
    if remembered is None:
        raise DataError(
            f"{root}: knows no hashes of whole pictures, since it was begun without --verify-data; "
            "drop it here"
        )
    found = picture_hashes.whole(scene.root, scene.files, scene.decoded)
    if found != remembered:
        _refuse(root, scene, picture_hashes.difference(found, remembered))


def _remembered(root: Path) -> Mapping[str, Hashes]:
    path = root / PICTURES
    document = read_json(path) if path.is_file() else {}
    return {key: document[key] for key in (SAMPLED, WHOLE) if isinstance(document.get(key), dict)}


def _refuse(root: Path, scene: Scene, difference: str | None) -> None:
    raise DataError(
        f"{scene.root}: is not the data that {root} was trained on: "
        f"{difference or 'its pictures have changed'}; restore it, or give the folder as it was "
        "with --data"
    )
