"""Reads Neural 3D Video (N3V, DyNeRF): ``poses_bounds.npy`` and a video per camera.

Facts: Li et al. 2022 and LLFF's ``poses_bounds.npy``; the first camera is for testing, and
pictures are measured at half their size. Frames are decoded once, to where 4D-GS's scripts put them
as well.
"""

from __future__ import annotations

import re
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _world
from gsdmsr_cli.formats._arrays import read_npy
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.locks import in_turn
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.imaging import image_size, resize_area, write_png
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.scene.video import read_video, video_length

SIGN = "poses_bounds.npy and cam00.mp4 or cam00/images"

HALVED_FROM = 2000
"""Videos as wide as this are halved, as in the papers [px]."""

FRAME_RATE = 30.0
"""Of all videos of the data set [1 / s]."""

_ELSEWHERE = (
    "frames are decoded there, once; copy the data to a folder that can be written, or change the "
    "rights"
)
"""What to do where the frames of videos cannot be written."""

_PART = ".part"
_STALE = re.compile(rf"\.images\.[0-9a-f]{{32}}{re.escape(_PART)}")
"""What a killed process leaves of a video that it was decoding."""


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds the poses of a rig and its videos or their frames."""
    return (folder / "poses_bounds.npy").is_file() and bool(_cameras(folder))


def is_prepared(folder: Path) -> bool:
    """Return whether the frames of all videos are there."""
    return all(_frames_of(folder, name).is_dir() for name in _cameras(folder))


def prepare(folder: Path, on_progress: OnProgress) -> None:
    """Decode the videos whose frames are not there yet, each to all of its frames or none.

    Raises:
        DataError: a video cannot be decoded, or a frame not be written.
    """
    videos = [
        folder / f"{name}.mp4" for name in _cameras(folder) if not _frames_of(folder, name).is_dir()
    ]
    done, total = 0, sum(map(video_length, videos))

    def count() -> None:
        nonlocal done
        done += 1
        on_progress(done, max(done, total))

    for video in videos:
        _decode(video, _frames_of(folder, video.stem), count)


def read(folder: Path) -> Scene:
    """Read a capture whose videos have been decoded by ``prepare``.

    Raises:
        DataError: something in it cannot be used; the message names the file.
    """
    names = _cameras(folder)
    path = folder / "poses_bounds.npy"
    rows = _rows(path, len(names))
    pictures = [sorted(_frames_of(folder, name).glob("*.png")) for name in names]
    longest = max(map(len, pictures))
    for name, found in zip(names, pictures, strict=True):
        if not found:
            raise DataError(
                f"{_frames_of(folder, name)}: no PNG pictures; remove it to decode again"
            )
    views = [
        View(
            name=f"{name}_{picture.stem}",
            camera=camera,
            time=i / max(longest - 1, 1),
            split="test" if name == names[0] else "train",
            image_path=picture,
        )
        for name, row, found in zip(names, rows, pictures, strict=True)
        for camera in [_camera(row, found[0], f"{path}: {name}")]
        for i, picture in enumerate(found)
    ]
    checks.one_size(views)
    nearest, farthest = float(rows[:, 15].min()), float(rows[:, 16].max())
    one_moment = [view for view in views if view.time == 0]
    world = _world.normalize(one_moment, np.zeros((0, 3)), (nearest, farthest))
    return Scene(
        root=folder,
        layout="neural3d",
        views=world.views(views),
        points=np.zeros((0, 3), np.float32),
        colours=None,
        duration=longest / FRAME_RATE,
        bound=world.bound,
        fingerprint=checks.fingerprint([path]),
    )


def _cameras(folder: Path) -> list[str]:
    """Return the names of the cameras that have a video or frames, in order."""
    videos = {path.stem for path in folder.glob("cam*.mp4")}
    decoded = {path.parent.name for path in folder.glob("cam*/images")}
    return sorted(name for name in videos | decoded if re.fullmatch(r"cam\d+", name))


def _frames_of(folder: Path, camera: str) -> Path:
    return folder / camera / "images"


def _decode(video: Path, target: Path, count: Callable[[], None]) -> None:
    """Write the frames of a video as PNG files below ``target``, which appears whole.

    Of several processes one decodes, and the others wait for what it has decoded.
    """
    with in_turn(target.parent, _ELSEWHERE):
        if target.is_dir():
            return
        beside = target.with_name(f".{target.name}.{uuid.uuid4().hex}{_PART}")
        try:
            for stale in target.parent.iterdir():
                if _STALE.fullmatch(stale.name):
                    shutil.rmtree(stale, ignore_errors=True)
            beside.mkdir()
            for i, (_, picture) in enumerate(read_video(video)):
                write_png(beside / f"{i:04d}.png", _halved(picture))
                count()
            beside.replace(target)
        except OSError as error:
            reason = error.strerror or error
            raise DataError(f"{target}: cannot be written: {reason}; is the disk full?") from error
        finally:
            shutil.rmtree(beside, ignore_errors=True)


def _halved(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width, _ = picture.shape
    if width < HALVED_FROM:
        return picture
    small = resize_area(picture.astype(np.float32), width // 2, height // 2)
    return np.rint(small).astype(np.uint8)


def _rows(path: Path, cameras: int) -> NDArray[np.float64]:
    """Return LLFF's (cameras, 17) numbers: 3 x 5 of pose and size, nearest and farthest depth."""
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise DataError(f"{path}: has shape {rows.shape}; it must hold (cameras, 17) numbers")
    if len(rows) != cameras:
        raise DataError(f"{path}: has {len(rows)} poses, but there are {cameras} cameras")
    if not (np.isfinite(rows).all() and (rows[:, 15:] > 0).all()):
        raise DataError(f"{path}: holds NaN, infinity or a depth that is not above 0")
    return rows


def _camera(row: NDArray[np.float64], picture: Path, where: str) -> Camera:
    """Return the camera of a row, at the size of its pictures."""
    table = row[:15].reshape(3, 5)
    down, right, back, centre = table[:, :4].T
    pose = np.eye(4)
    pose[:3] = np.stack([right, down, -back, centre], axis=1)
    pose = checks.rigid_pose(pose.tolist(), where)
    height, width = (checks.pixels(float(side), f"{where}: size") for side in table[:2, 4])
    focal = checks.positive(float(table[2, 4]), f"{where}: focal length")
    size = image_size(picture)
    checks.same_shape((width, height), size, picture)
    inverse = np.asarray(np.linalg.inv(pose), dtype=np.float64)
    camera = Camera(inverse, focal, focal, width / 2, height / 2, width, height)
    return camera.resized(*size)
