"""Reads a picture's EXIF tags: orientation, time of exposure and focal length."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.native import OpenImageIO
from gsdmsr_cli.scene.picture_files import IN_CAPTURES, opened

FULL_FRAME_DIAGONAL = math.hypot(36, 24)
"""Of the film that "35 mm equivalent" focal lengths refer to [mm]."""


@dataclass(frozen=True)
class ExifTags:
    """EXIF tags of one picture.

    Attributes:
        orientation: of EXIF, 1 to 8.
        taken: seconds since 1970, local time, or None.
        focal: focal length over the picture's diagonal, or None.
    """

    orientation: int = 1
    taken: float | None = None
    focal: float | None = None


def read_exif(path: Path) -> ExifTags:
    """Return the tags of a picture, empty where it has none or cannot be read."""
    try:
        with opened(path, IN_CAPTURES) as source:
            spec = source.spec()
    except DataError:  # decoding the pixels will show
        return ExifTags()
    orientation = spec.getattribute("Orientation") or 1
    return ExifTags(
        orientation if orientation in range(1, 9) else 1,
        _taken(spec),
        _focal(spec.getattribute("Exif:FocalLengthIn35mmFilm")),
    )


def _taken(spec: OpenImageIO.ImageSpec) -> float | None:
    text = spec.getattribute("Exif:DateTimeOriginal")
    fraction = spec.getattribute("Exif:SubsecTimeOriginal") or "0"
    try:
        moment = datetime.strptime(str(text), "%Y:%m:%d %H:%M:%S")
        parts = float(f"0.{int(str(fraction).strip()):0{len(str(fraction).strip())}d}")
    except ValueError:
        return None
    return (moment - datetime(1970, 1, 1)).total_seconds() + parts


def _focal(equivalent: object) -> float | None:
    if isinstance(equivalent, int | float) and 1 <= equivalent <= 2000:
        return float(equivalent) / FULL_FRAME_DIAGONAL
    return None


def upright(picture: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Return (H, W, C) pixels turned and mirrored as EXIF's orientation, 1 to 8, asks."""
    turned = picture.swapaxes(0, 1) if orientation >= 5 else picture
    if orientation in (3, 4, 7, 8):
        turned = turned[::-1]
    if orientation in (2, 3, 6, 7):
        turned = turned[:, ::-1]
    return np.ascontiguousarray(turned)
