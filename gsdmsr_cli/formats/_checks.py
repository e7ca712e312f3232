"""Checks what a data set's files hold: numbers, poses, paths and JSON."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from reprlib import Repr
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.scene import View

EXTENSIONS = (".png", ".jpg", ".jpeg")
"""Tried in turn after a picture's path that names no file as it stands."""

MOST_PIXELS = 1_000_000
"""Longest side that a camera's picture may be said to have; the files may be shrunk ones."""

RIGID_TOLERANCE = 1e-3
"""Largest deviation of R^T R from the identity in a pose."""


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        DataError: the file cannot be read, is not JSON, or holds something else than an object.
    """
    try:
        document = json.loads(path.read_bytes().decode("utf-8-sig"))
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        raise DataError(f"{path}: malformed JSON at {where}: {error.msg}; correct it") from error
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: malformed JSON: {error}; correct it") from error
    return mapping(document, str(path))


def mapping(value: object, where: str) -> dict[str, Any]:
    """Return ``value`` if it is a JSON object, else raise DataError."""
    if not isinstance(value, dict):
        raise DataError(f"{where}: {shown(value)} found where a JSON object {{...}} must stand")
    return value


def sequence(value: object, where: str) -> list[Any]:
    """Return ``value`` if it is a JSON list, else raise DataError."""
    if not isinstance(value, list):
        raise DataError(f"{where}: {shown(value)} found where a JSON list [...] must stand")
    return value


def number(value: object, where: str) -> float:
    """Return ``value`` if it is a finite number, else raise DataError."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            result = float(value)
        except OverflowError:
            result = math.inf
        if math.isfinite(result):
            return result
    raise DataError(f"{where} is {shown(value)}; it must be a finite number")


def positive(value: object, where: str) -> float:
    """Return ``value`` if it is a finite number above 0, else raise DataError."""
    result = number(value, where)
    if result <= 0:
        raise DataError(f"{where} is {result}; it must be above 0")
    return result


def pixels(value: object, where: str) -> int:
    """Return ``value`` if it is a whole number above 0, else raise DataError."""
    result = number(value, where)
    if not 1 <= result <= MOST_PIXELS or result != int(result):
        raise DataError(
            f"{where} is {result:g}; it must be a whole number of pixels, 1 to {MOST_PIXELS}"
        )
    return int(result)


def numbers(value: object, count: int, where: str) -> list[float]:
    """Return ``value`` if it is a list of so many finite numbers, else raise DataError."""
    listed = sequence(value, where)
    if len(listed) != count:
        raise DataError(f"{where} holds {len(listed)} entries; it must hold {count} numbers")
    return [number(entry, f"{where}: an entry") for entry in listed]


def unit_time(value: object, where: str) -> float:
    """Return ``value`` if it is a number in [0, 1], else raise DataError."""
    time = number(value, where)
    if not 0 <= time <= 1:
        raise DataError(f"{where} is {time}; it must lie in [0, 1]: divide all by the last time")
    return time


def rigid_pose(value: object, where: str) -> NDArray[np.float64]:
    """Return a (4, 4) rigid transform from nested lists.

    Raises:
        DataError: it is not 4 x 4 finite numbers, or not a rotation with a translation.
    """
    rows = [sequence(row, where) for row in sequence(value, where)]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise DataError(f"{where} is not 4 x 4 numbers")
    pose = np.array([[number(entry, f"{where}: an entry") for entry in row] for row in rows])
    if not np.allclose(pose[3], [0, 0, 0, 1], rtol=0, atol=1e-6):
        raise DataError(f"{where} is not a rigid pose: its last row is not 0 0 0 1")
    rotation = pose[:3, :3]
    gram = rotation.T @ rotation
    scale = math.sqrt(np.trace(gram) / 3)
    if np.abs(gram - np.eye(3)).max() > RIGID_TOLERANCE:
        uniform = np.abs(gram - scale**2 * np.eye(3)).max() <= RIGID_TOLERANCE * scale**2
        problem = (
            f"its rotation is scaled by {scale:.6g}; divide it by that"
            if uniform and scale > 0
            else "the columns of its rotation are not orthonormal"
        )
        raise DataError(f"{where} is not a rigid pose: {problem}")
    if np.linalg.det(rotation) < 0:
        raise DataError(f"{where} is not a rigid pose: its rotation mirrors (determinant -1)")
    return pose


def picture_path(root: Path, text: object, where: str, within: Path | None = None) -> Path:
    """Return the picture that ``text`` names relative to ``root``, whose extension may be missing.

    Args:
        root: folder that ``text`` is relative to.
        text: as the file has it.
        where: place in the file, for messages.
        within: folder that ``root`` must not lead out of by a link.

    Raises:
        DataError: it names nothing, or something outside of ``root`` or ``within``.
    """
    path = _inner_path(root, text, where, ("", *EXTENSIONS), within)
    if path is None:
        raise DataError(
            f"{where}: image {root / _relative(root, text, where)} does not exist, nor with "
            f"{', '.join(EXTENSIONS)}; restore it or remove the frame"
        )
    return path


def inner_path(root: Path, text: object, where: str) -> Path:
    """Return the file that ``text`` names relative to ``root``.

    Raises:
        DataError: it names nothing, or something outside of ``root``.
    """
    path = path_if_there(root, text, where)
    if path is None:
        raise DataError(
            f"{where}: {root / _relative(root, text, where)} does not exist; restore it"
        )
    return path


def path_if_there(root: Path, text: object, where: str, within: Path | None = None) -> Path | None:
    """Return the file that ``text`` names relative to ``root``, None if there is no such file.

    Raises:
        DataError: it is no name, or leads out, see ``picture_path``.
    """
    return _inner_path(root, text, where, ("",), within)


def _inner_path(
    root: Path, text: object, where: str, extensions: tuple[str, ...], within: Path | None
) -> Path | None:
    relative = _relative(root, text, where)
    limits = [root] if within is None else [root, within]
    try:
        for extension in extensions:
            path = root / (relative + extension)
            real = path.resolve()
            for limit in limits:
                if not real.is_relative_to(limit.resolve()):
                    raise DataError(
                        f"{where} is {shown(text)}, which leads out of {limit}; put the file inside"
                    )
            if path.is_file():
                return path
    except (OSError, ValueError, RuntimeError) as error:  # Too long, a null byte, a loop of links.
        raise DataError(f"{where} is {shown(text)}, which is not a usable path") from error
    return None


def _relative(root: Path, text: object, where: str) -> str:
    if not isinstance(text, str) or not text.strip():
        raise DataError(f"{where} is {shown(text)}; it must name a file")
    relative = text.replace("\\", "/")
    if PurePosixPath(relative).is_absolute() or PureWindowsPath(relative).drive:
        raise DataError(f"{where} is {shown(text)}; it must be relative to {root}")
    return relative


def same_shape(said: tuple[int, int], found: tuple[int, int], image: Path) -> None:
    """Raise DataError unless a picture has the stated (width, height), or is resampled from it.

    Pictures may have been shrunk after their cameras were written, but not cropped.
    """
    if abs(said[1] * found[0] / said[0] - found[1]) > 1:
        raise DataError(
            f"image {image} is {found[0]} x {found[1]} px, but its camera's size is "
            f"{said[0]} x {said[1]}; give the picture that the camera belongs to"
        )


def one_size(views: Sequence[View]) -> None:
    """Raise DataError unless all pictures are of one size."""
    first = views[0]
    size = (first.camera.width, first.camera.height)
    for view in views:
        if (view.camera.width, view.camera.height) != size:
            raise DataError(
                f"image {view.image_path} is {view.camera.width} x {view.camera.height} px, but "
                f"{first.image_path} is {size[0]} x {size[1]}; all frames must have one size"
            )


def mask_size(mask: Path, size: tuple[int, int], view: View) -> None:
    """Raise DataError unless a mask's (width, height) is that of the view's picture."""
    camera = view.camera
    if size != (camera.width, camera.height):
        raise DataError(
            f"mask {mask} is {size[0]} x {size[1]} px, but {view.image_path} is "
            f"{camera.width} x {camera.height}; they must agree"
        )


def unique_names(names: Iterable[str]) -> list[str]:
    """Return the names in order, with _2, _3, ... after those that were there before."""
    names = list(names)
    taken = set(names)
    seen: set[str] = set()
    result = []
    for name in names:
        unique, count = name, 1
        while unique in seen or (count > 1 and unique in taken):
            count += 1
            unique = f"{name}_{count}"
        seen.add(unique)
        result.append(unique)
    return result


def fingerprint(paths: Iterable[Path]) -> str:
    """Return 16 hexadecimal digits of the SHA-256 over the files' bytes."""
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def shown(value: object) -> str:
    """Return what a file holds in a form for messages, short and whatever it is."""
    text = _SHORT.repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 60, 60
