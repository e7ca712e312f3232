"""Reads the parts that ``transforms*.json`` of D-NeRF, instant-ngp and nerfstudio share."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.scene import View

CAMERA_KEYS = (
    "camera_model", "camera_angle_x", "camera_angle_y", "fl_x", "fl_y", "cx", "cy", "w", "h",
    "k1", "k2", "k3", "k4", "p1", "p2",
)  # fmt: skip
"""Fields that frames inherit from the level above them."""

_PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
_BROWN = ("OPENCV", "PERSPECTIVE", "RADIAL", "SIMPLE_RADIAL")
_FISHEYE = "OPENCV_FISHEYE"


def read_view(folder: Path, split: str, time: float, fields: dict[str, Any], where: str) -> View:
    """Return the view of one frame, in the world of the file.

    Raises:
        DataError: a field is missing or cannot be used.
    """
    path = checks.picture_path(folder, fields["file_path"], f"{where}: file_path")
    pose = checks.rigid_pose(fields["transform_matrix"], f"{where}: transform_matrix")
    lens = _lens(fields, path, where)
    return View(
        name=path.stem,
        camera=lens.camera(world_to_camera(pose)),
        time=time,
        split=split,
        image_path=path,
        lens=None if lens.is_pinhole else lens,
    )


def require(fields: dict[str, Any], where: str) -> str:
    """Return ``where`` with the picture's name, if the frame has a picture and a pose.

    Raises:
        DataError: one of them is missing.
    """
    for key in ("file_path", "transform_matrix"):
        if key not in fields:
            raise DataError(f"{where}: no '{key}'; every frame needs one")
    return f"{where} ({fields['file_path']!s:.60})"


def world_to_camera(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert a camera-to-world pose in OpenGL axes (y up, z backward) into OpenCV axes."""
    flipped = pose @ np.diag([1.0, -1.0, -1.0, 1.0])
    return np.asarray(np.linalg.inv(flipped), dtype=np.float64)


def _lens(fields: dict[str, Any], image: Path, where: str) -> Lens:
    """Return the lens at the size of the picture ``image``; w and h may say another."""
    size = image_size(image)
    width, height = (
        checks.pixels(fields.get(key, n), f"{where}: {key}")
        for key, n in zip("wh", size, strict=True)
    )
    checks.same_shape((width, height), size, image)
    fx = _focal(fields, "x", width, where)
    if fx is None:
        raise DataError(f"{where}: no 'camera_angle_x' and no 'fl_x'; one of them is needed")
    radial, tangential, fisheye = _distortion(fields, where)
    lens = Lens(
        fx=fx,
        fy=_focal(fields, "y", height, where) or fx,
        cx=checks.number(fields.get("cx", width / 2), f"{where}: cx"),
        cy=checks.number(fields.get("cy", height / 2), f"{where}: cy"),
        width=width,
        height=height,
        radial=radial,
        tangential=tangential,
        fisheye=fisheye,
    )
    return lens.resized(*size)


def _distortion(
    fields: dict[str, Any], where: str
) -> tuple[tuple[float, ...], tuple[float, float], bool]:
    """Return the radial and the tangential terms, and whether the former are a fisheye's."""
    model = fields.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (
        checks.number(fields.get(key, 0), f"{where}: {key}")
        for key in ("k1", "k2", "k3", "k4", "p1", "p2")
    )
    if model == _FISHEYE:
        return (k1, k2, k3, k4), (0.0, 0.0), True
    if model in _PINHOLES:
        return (), (0.0, 0.0), False
    if model not in _BROWN:
        known = ", ".join((*_PINHOLES, *_BROWN, _FISHEYE))
        found = checks.shown(model)
        raise DataError(f"{where}: camera_model is {found}; it must be one of {known}")
    if k4:
        raise DataError(f"{where}: k4 is {k4}; it must be 0 but for {_FISHEYE}: undistort first")
    return (k1, k2, k3), (p1, p2), False


def _focal(fields: dict[str, Any], axis: str, size: int, where: str) -> float | None:
    """Return the focal length [px] along ``axis``, or None if the fields do not give it."""
    length, angle = f"fl_{axis}", f"camera_angle_{axis}"
    if length in fields:
        return checks.positive(fields[length], f"{where}: {length}")
    if angle not in fields:
        return None
    field_of_view = checks.number(fields[angle], f"{where}: {angle}")
    if not 0 < field_of_view < math.pi:
        raise DataError(f"{where}: {angle} is {field_of_view}; it must lie in (0, pi) radians")
    return 0.5 * size / math.tan(field_of_view / 2)
