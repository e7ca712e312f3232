"""Reads COLMAP's models, binary and text: cameras, images and points.

Facts: COLMAP's documentation of its output format and of its camera models (Schoenberger and Frahm
2016), version 4.2.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.formats._checks import MOST_PIXELS
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.lens import Lens

Floats = NDArray[np.float64]
T = TypeVar("T")

_MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5),
    4: ("OPENCV", 8), 5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12),
    8: ("SIMPLE_RADIAL_FISHEYE", 4), 9: ("RADIAL_FISHEYE", 5),
    14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
}  # fmt: skip
"""Identifier to name and number of parameters."""

_COUNTS = dict(_MODELS.values())

_ROWS = 1 << 16
"""Points that are taken from a binary file at a time."""


class Image(NamedTuple):
    """A registered picture.

    Attributes:
        name: path below the folder of pictures.
        world_to_camera: (4, 4), OpenCV axes.
        camera: identifier of its camera.
    """

    name: str
    world_to_camera: Floats
    camera: int


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A reconstruction.

    Attributes:
        cameras: lens of each camera, by its identifier.
        images: by name.
        points: (P, 3) in the model's own world.
        colours: (P, 3) in [0, 1].
        files: that it was read from.
    """

    cameras: dict[int, Lens]
    images: list[Image]
    points: Floats
    colours: NDArray[np.float32]
    files: tuple[Path, ...]


def is_model(folder: Path) -> bool:
    """Return whether ``folder`` holds the files of a model."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_model(folder: Path) -> ColmapModel:
    """Read the model in ``folder``, the binary one where there are both.

    Raises:
        DataError: a file is missing, damaged, or has a camera that is not known here.
    """
    binary = (folder / "cameras.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    paths = tuple(folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D"))
    parse = (_cameras, _images, _points) if binary else (_cameras_text, _images_text, _points_text)
    cameras = dict(_whole(parse[0], paths[0]))
    images = sorted(_whole(parse[1], paths[1]), key=lambda image: image.name)
    table = np.concatenate([np.empty((0, 6)), *_whole(parse[2], paths[2])])
    table = table[np.isfinite(table).all(axis=1)]
    return ColmapModel(cameras, images, table[:, :3], (table[:, 3:] / 255).astype("f4"), paths)


def _whole(parse: Callable[[Path], Iterator[T]], path: Path) -> list[T]:
    """Return what ``parse`` makes of a file, with what is wrong with it as one line."""
    try:
        return list(parse(path))
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror or error}") from error
    except (ValueError, IndexError, OverflowError, struct.error) as error:
        raise DataError(f"{path}: is damaged: {_brief(error)}; export the model again") from error


def _brief(error: Exception) -> str:
    return f"{error}"[:300]


def _lens(model: str, width: int, height: int, parameters: list[float]) -> Lens:
    """Return the lens of a camera; what models have in common is their order of parameters."""
    if len(parameters) != _COUNTS[model]:
        raise ValueError(f"{model} with {len(parameters)} parameters, not {_COUNTS[model]}")
    square = model.startswith(("SIMPLE", "RADIAL"))  # one focal length
    fx, fy, cx, cy, *terms = [*parameters[:1], *parameters] if square else parameters
    sizes = min(width, height) >= 1 and max(width, height) <= MOST_PIXELS
    if not (sizes and np.isfinite(parameters).all() and min(fx, fy) > 0):
        raise ValueError(f"a camera of {width} x {height} px with the parameters {parameters}")
    fisheye = model.endswith("FISHEYE")
    tangential = (0.0, 0.0)
    if model in ("OPENCV", "FULL_OPENCV"):
        tangential = terms[2], terms[3]
        terms = [*terms[:2], *terms[4:]]
    return Lens(fx, fy, cx, cy, width, height, tuple(terms), tangential, fisheye=fisheye)


def _known(path: Path, model: str | None, found: object) -> str:
    if model not in _COUNTS:
        known = ", ".join(_COUNTS)
        raise DataError(f"{path}: camera model {found}; known are {known}: undistort with COLMAP")
    return model


def _pose(numbers: tuple[float, ...]) -> Floats:
    """Return the pose of qw qx qy qz tx ty tz."""
    length = math.hypot(*numbers[:4])
    if not 0 < length < math.inf:
        raise ValueError("a rotation that is none")
    w, x, y, z = (number / length for number in numbers[:4])
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = numbers[4:]
    if not np.isfinite(pose).all():
        raise ValueError("a pose that is not finite")
    return pose


def _cameras(path: Path) -> Iterator[tuple[int, Lens]]:
    data, at = path.read_bytes(), 8
    for _ in range(*struct.unpack_from("<Q", data)):
        identifier, number, width, height = struct.unpack_from("<iiQQ", data, at)
        name, count = _MODELS.get(number, (None, 0))
        model = _known(path, name, f"number {number}")
        parameters = list(struct.unpack_from(f"<{count}d", data, at + 24))
        yield identifier, _lens(model, width, height, parameters)
        at += 24 + 8 * count


def _images(path: Path) -> Iterator[Image]:
    data, at = path.read_bytes(), 8
    for _ in range(*struct.unpack_from("<Q", data)):
        numbers = struct.unpack_from("<7d", data, at + 4)
        (camera,) = struct.unpack_from("<i", data, at + 60)
        end = data.index(b"\0", at + 64)
        name = _name(data[at + 64 : end])
        (observations,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * observations
        yield Image(name, _pose(numbers), camera)
    if at > len(data):
        raise ValueError("it ends too early")


def _name(text: bytes) -> str:
    try:
        return text.decode()
    except UnicodeDecodeError:
        raise ValueError(f"the name of an image is {text[:60]!r}, which is not UTF-8") from None


def _points(path: Path) -> Iterator[Floats]:
    """Yield the (P, 6) table of points at once: models have millions.

    A point has 51 bytes and its track, so where one begins is known from the one before alone.
    """
    data, at = path.read_bytes(), 8
    (count,) = struct.unpack_from("<Q", data)
    if count > len(data) // 51:
        raise ValueError("it ends too early")
    starts, track = np.empty(count, np.int64), struct.Struct("<Q")
    for i in range(count):
        starts[i] = at
        at += 51 + 8 * track.unpack_from(data, at + 43)[0]
    if at > len(data):
        raise ValueError("it ends too early")
    content, table = np.frombuffer(data, np.uint8), np.empty((count, 6))
    for first in range(0, count, _ROWS):
        rows = content[starts[first : first + _ROWS, None] + np.arange(8, 8 + 27)]
        table[first : first + _ROWS, :3] = np.ascontiguousarray(rows[:, :24]).view("<f8")
        table[first : first + _ROWS, 3:] = rows[:, 24:]
    yield table


def _lines(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if not line.startswith("#")]


def _cameras_text(path: Path) -> Iterator[tuple[int, Lens]]:
    for line in _lines(path):
        if words := line.split():
            model = _known(path, words[1], f"'{words[1]:.60}'")
            parameters = [float(word) for word in words[4:]]
            yield int(words[0]), _lens(model, int(words[2]), int(words[3]), parameters)


def _images_text(path: Path) -> Iterator[Image]:
    """Every second line lists the points that an image sees, and may be empty."""
    for line in _lines(path)[::2]:
        if line.strip():
            words = line.split(maxsplit=9)
            yield Image(words[9].strip(), _pose(tuple(map(float, words[1:8]))), int(words[8]))


def _points_text(path: Path) -> Iterator[Floats]:
    """Yield the (P, 6) table of points at once."""
    rows = [words[1:7] for line in _lines(path) if (words := line.split())]
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    if not ((table[:, 3:] >= 0) & (table[:, 3:] <= 255)).all():
        raise ValueError("a point has a colour outside 0 to 255")
    yield table
