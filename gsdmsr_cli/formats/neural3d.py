"""Reads Neural 3D Video (N3V, DyNeRF): ``poses_bounds.npy`` and a video per camera.

Facts: Li et al. 2022 and LLFF's ``poses_bounds.npy``; the first camera is for testing, and
pictures are measured at half their size. Frames are decoded once, to where 4D-GS's scripts put them
as well, or to a folder of the user's.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.formats import _checks as checks
from gsdmsr_cli.formats import _world
from gsdmsr_cli.formats._arrays import read_npy
from gsdmsr_cli.formats._decoded import decode_videos, frames_of, place_of_frames
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.scene import Scene, View

SIGN = "poses_bounds.npy and cam00.mp4 or cam00/images"

HALVED_FROM = 2000
"""Videos as wide as this are halved, as in the papers [px]."""

SHOWN = 3
"""At most so many cameras are named of which pictures are missing."""

FRAME_RATE = 30.0
"""Of all videos of the data set [1 / s]."""


def matches(folder: Path) -> bool:
    """Return whether ``folder`` holds the poses of a rig and its videos or their frames."""
    return (folder / "poses_bounds.npy").is_file() and bool(_cameras(folder))


def place_of(folder: Path) -> Path:
    """Return where frames that are not in ``folder`` are, or are to be decoded.

    Raises:
        DataError: a video cannot be read.
    """
    return place_of_frames(folder, _videos(folder))


def is_prepared(folder: Path) -> bool:
    """Return whether the frames of all videos are there."""
    videos = _videos(folder)
    place = place_of_frames(folder, videos)
    return all(frames_of(place, video.stem).is_dir() for video in videos)


def prepare(folder: Path, place: Path, on_progress: OnProgress) -> None:
    """Decode the videos whose frames are not there yet, each to all of its frames or none.

    Raises:
        DataError: a video cannot be decoded, or a frame not be written.
    """
    decode_videos(folder, _videos(folder), place, HALVED_FROM, on_progress)


def read(folder: Path, place: Path) -> Scene:
    """Read a capture whose videos have been decoded by ``prepare``, to ``place``.

    Raises:
        DataError: something in it cannot be used; the message names the file.
    """
    names = _cameras(folder)
    path = folder / "poses_bounds.npy"
    rows = _rows(path, len(names))
    folders = [_own_or_decoded(folder, place, name) for name in names]
    pictures = [sorted(own.glob("*.png")) for own in folders]
    for own, found in zip(folders, pictures, strict=True):
        if not found:
            raise DataError(f"{own}: no PNG pictures; remove it to decode again")
    numbers = _numbers(pictures)
    longest = 1 + max(max(own) for own in numbers)
    _tell_of_missing(folder, names, numbers)
    views = [
        View(
            name=f"{name}_{picture.stem}",
            camera=camera,
            time=number / max(longest - 1, 1),
            split="test" if name == names[0] else "train",
            image_path=picture,
        )
        for name, row, found, own in zip(names, rows, pictures, numbers, strict=True)
        for camera in [_camera(row, found[0], f"{path}: {name}")]
        for number, picture in zip(own, found, strict=True)
    ]
    checks.one_size(views)
    nearest, farthest = float(rows[:, 15].min()), float(rows[:, 16].max())
    one_moment = list({view.camera: view for view in reversed(views)}.values())[::-1]
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
        decoded=place,
    )


def _numbers(pictures: Sequence[Sequence[Path]]) -> list[list[int]]:
    """Return the moment of every picture of every camera, from 0.

    They are in the names; where a name is no number, pictures follow one another without a gap.
    """
    if not all(path.stem.isdecimal() for found in pictures for path in found):
        return [list(range(len(found))) for found in pictures]
    numbers = [[int(path.stem) for path in found] for found in pictures]
    first = min(map(min, numbers))
    return [[number - first for number in own] for own in numbers]


def _tell_of_missing(folder: Path, names: Sequence[str], numbers: Sequence[Sequence[int]]) -> None:
    """Warn of cameras that have no picture at moments that others have."""
    known = {number for own in numbers for number in own}
    gaps = {n: sorted(known - {*own}) for n, own in zip(names, numbers, strict=True)}
    told = [
        f"{name} has none at {len(gap)} of {len(known)} moments, such as the {gap[0] + 1}."
        for name, gap in gaps.items()
        if gap
    ]
    if told:
        more = f" and {len(told) - SHOWN} more cameras have gaps" if len(told) > SHOWN else ""
        say.warn(f"{folder}: pictures are missing: {'; '.join(told[:SHOWN])}{more}")


def _cameras(folder: Path) -> list[str]:
    """Return the names of the cameras that have a video or frames, in order."""
    videos = {path.stem for path in folder.glob("cam*.mp4")}
    decoded = {path.parent.name for path in folder.glob("cam*/images")}
    return sorted(name for name in videos | decoded if re.fullmatch(r"cam\d+", name))


def _videos(folder: Path) -> list[Path]:
    """Return the videos of the cameras that have no frames in ``folder``."""
    names = _cameras(folder)
    return [folder / f"{n}.mp4" for n in names if not frames_of(folder, n).is_dir()]


def _own_or_decoded(folder: Path, place: Path, camera: str) -> Path:
    """Return the folder of a camera's frames: that of the data set, if it is there."""
    own = frames_of(folder, camera)
    return own if own.is_dir() else frames_of(place, camera)


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
