"""Reads a COLMAP model with its pictures: ``sparse/0`` beside ``images``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _colmap, _world
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.scene import Scene, View

SIGN = "sparse/0/cameras.bin or .txt"

MODELS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""Where a model may lie; the first that is there."""

PICTURES = ("images", "input", "rgb", "colmap/images", ".")
"""Where its pictures may lie; the first that holds the first of them."""

TEST_EVERY = 8
"""Every 8th picture by name, from the first on, is for testing (Mip-NeRF 360, 3DGS)."""

_DIGITS = 30
"""Longer numbers in names are no times."""

_OTHERS = (
    "transforms.json", "transforms_train.json", "dataset.json", "train_meta.json", "cam*.mp4",
    "cam*/images",
)  # fmt: skip
"""Files of layouts that say more and may have a COLMAP model beside them."""


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds a COLMAP model, and nothing that says more."""
    return _model_folder(folder) is not None and not any(any(folder.glob(n)) for n in _OTHERS)


def read(folder: Path) -> Scene:
    """Read a COLMAP model and its pictures.

    Raises:
        DataError: something in it cannot be used; the message names the file.
    """
    model_folder = _model_folder(folder)
    if model_folder is None:
        raise DataError(f"{folder}: no COLMAP model; looked for {', '.join(MODELS)}")
    model = _colmap.read_model(model_folder)
    images = model.images
    if not images:
        raise DataError(f"{model_folder}: no registered images; at least one is needed")
    pictures = _picture_folder(folder, images[0].name, f"{model.files[1]}")
    times = times_by_name([image.name for image in images])
    views = [
        _read_view(folder, pictures, image, model, time, _split(i, len(images)))
        for i, (image, time) in enumerate(zip(images, times, strict=True))
    ]
    checks.one_size(views)
    names = checks.unique_names(view.name for view in views)
    views = [replace(view, name=name) for view, name in zip(views, names, strict=True)]
    world = _world.normalize(views, model.points)
    return Scene(
        root=folder,
        layout="colmap",
        views=world.views(views),
        points=world.points(model.points),
        colours=model.colours,
        duration=None,
        bound=world.bound,
        fingerprint=checks.fingerprint(model.files),
    )


def _model_folder(folder: Path) -> Path | None:
    return next((folder / m for m in MODELS if _colmap.is_model(folder / m)), None)


def _picture_folder(folder: Path, first: str, where: str) -> Path:
    for name in PICTURES:
        if checks.path_if_there(folder / name, first, f"{where}: a name", within=folder):
            return folder / name
    raise DataError(
        f"{folder}: image '{first:.60}' of its COLMAP model is in none of {', '.join(PICTURES)}"
    )


def times_by_name(names: list[str]) -> list[float]:
    """Return times in [0, 1] from the last number in each file's name, else from the names' order.

    So pictures of several cameras may share their times: ``left/0007.png`` and ``right/0007.png``.
    """
    found = [re.findall(r"\d+", Path(name).stem) for name in names]
    moments = [int(numbers[-1]) for numbers in found if numbers and len(numbers[-1]) <= _DIGITS]
    if len(moments) < len(names) or len(set(moments)) < 2:
        moments = list(range(len(names)))
    first, last = min(moments), max(moments)
    return [(moment - first) / max(last - first, 1) for moment in moments]


def _split(i: int, count: int) -> str:
    return "test" if count > 1 and i % TEST_EVERY == 0 else "train"


def _read_view(
    folder: Path,
    pictures: Path,
    image: _colmap.Image,
    model: _colmap.ColmapModel,
    time: float,
    split: str,
) -> View:
    where = f"{model.files[1]}: '{image.name:.60}'"
    if image.camera not in model.cameras:
        raise DataError(f"{where}: camera {image.camera} is not in {model.files[0]}")
    path = checks.picture_path(pictures, image.name, where, within=folder)
    size, lens = image_size(path), model.cameras[image.camera]
    checks.same_shape((lens.width, lens.height), size, path)
    lens = lens.resized(*size)
    return View(
        name=Path(image.name).stem,
        camera=lens.camera(image.world_to_camera),
        time=time,
        split=split,
        image_path=path,
        lens=None if lens.is_pinhole else lens,
    )
