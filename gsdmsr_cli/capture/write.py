"""Writes a scene folder: undistorted pictures, transforms.json, points.ply and scene.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.masks import read_mask, write_mask
from gsdmsr_cli.formats.nerfstudio import MASK_KEYS
from gsdmsr_cli.ground.files import replacing, write_json
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.imaging import read_image, resample, write_png
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.scene import MOVING, SPLITS, View

SCHEMA = 1
"""Of scene.json; it grows when the meaning of a key changes."""

NOTE, POINTS, REPORT = "scene.json", "points.ply", "report.html"

TIMINGS = "timings.json"
"""The one file of a scene that differs between runs on the same input."""

_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_pictures(
    folder: Path,
    pictures: Path,
    views: Sequence[View],
    lens: Lens,
    on_progress: OnProgress,
) -> None:
    """Undistort the frames in ``pictures`` to the views' places below ``folder``."""
    for done, view in enumerate(views, start=1):
        target = folder / view.image_path
        target.parent.mkdir(parents=True, exist_ok=True)
        picture = read_image(pictures / view.image_path.name)
        write_png(target, picture if lens.is_pinhole else undistorted(picture, lens))
        on_progress(done, len(views))


def write_masks(folder: Path, masks: Path, views: Sequence[View], lens: Lens) -> tuple[View, ...]:
    """Undistort masks of what moves to ``folder``; return the views with them."""
    masked = []
    for view in views:
        target = Path("masks") / view.image_path.name
        (folder / target).parent.mkdir(exist_ok=True)
        moving = read_mask(masks / view.image_path.name)[..., None].astype(np.uint8) * 255
        straight = moving if lens.is_pinhole else undistorted(moving, lens)
        write_mask(folder / target, straight.reshape(moving.shape[:2]) >= 128)
        masked.append(replace(view, signals={**view.signals, MOVING: target}))
    return tuple(masked)


def undistorted(picture: NDArray[np.uint8], lens: Lens) -> NDArray[np.uint8]:
    """Return (H, W, C) pixels as the pinhole ``lens.camera`` shows them."""
    straight = resample(picture.astype(np.float32), *lens.sources())
    pixels: NDArray[np.uint8] = np.rint(straight).clip(0, 255).astype(np.uint8)
    return pixels


def write_transforms(path: Path, views: Sequence[View], points: str) -> None:
    """Write nerfstudio's description of the views.

    Camera-to-world matrices are in OpenGL axes (y up, z backward); each frame has a time in [0, 1].

    Args:
        path: the file.
        views: pictures are named relative to the file's folder.
        points: name of the file of points.
    """
    shared = _intrinsics(views[0].camera)
    frames = []
    for view in views:
        frame: dict[str, Any] = {
            "file_path": view.image_path.as_posix(),
            "time": view.time,
            "transform_matrix": _camera_to_world(view.camera),
        }
        own = _intrinsics(view.camera)
        frame |= {key: value for key, value in own.items() if value != shared[key]}
        frame |= {MASK_KEYS[name]: path.as_posix() for name, path in view.signals.items()}
        frames.append(frame)
    splits = {
        f"{split}_filenames": [v.image_path.as_posix() for v in views if v.split == split]
        for split in SPLITS
    }
    intrinsics = {"camera_model": "OPENCV", **shared}
    write_json(path, {**intrinsics, "ply_file_path": points, **splits, "frames": frames})


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }


def _camera_to_world(camera: Camera) -> list[list[float]]:
    """Return the inverse of a rigid pose, in OpenGL axes."""
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation.T
    pose[:3, 3] = camera.centre
    matrix: list[list[float]] = (pose @ _TO_OPENGL).tolist()
    return matrix


def write_points(path: Path, points: NDArray[np.float64], colours: NDArray[np.uint8]) -> None:
    """Write (P, 3) points and their colours as a binary PLY: x y z red green blue."""
    kinds = [(axis, "<f4") for axis in "xyz"]
    kinds += [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(points), kinds)
    for i in range(3):
        rows[kinds[i][0]], rows[kinds[i + 3][0]] = points[:, i], colours[:, i]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    text = "\n".join([*header, "end_header", ""])
    with replacing(path) as beside:
        beside.write_bytes(text.encode("ascii") + rows.tobytes())


def write_note(
    path: Path,
    bound: float,
    duration: float | None,
    provenance: Mapping[str, Any],
    quality: Mapping[str, Any] | None,
) -> None:
    """Write what the scene is and where it comes from.

    Args:
        path: the file.
        bound: see ``Scene.bound``.
        duration: of the capture [s].
        provenance: input, options, versions.
        quality: the report on the cameras, None where they were given.
    """
    document = {
        "gsdmsr": SCHEMA,
        "bound": bound,
        "duration": duration,
        **provenance,
        "quality": quality,
    }
    write_json(path, document)
