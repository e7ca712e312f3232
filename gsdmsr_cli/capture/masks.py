"""Reads and writes masks of moving parts: one picture per frame, white where it moves."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.candidates import Candidate
from gsdmsr_cli.capture.exif import read_exif, upright
from gsdmsr_cli.capture.features import Features, read_features
from gsdmsr_cli.capture.frames import Frames
from gsdmsr_cli.capture.source import PICTURES, Source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import write_json
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.imaging import read_image, write_png
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.picture_files import IN_CAPTURES

Mask = NDArray[np.bool_]

MARGIN = 0.008
"""Masks grow by this share of the longer side before features are left out: those at an edge see
both sides of it."""

COVERED = 0.98
"""From what is left of a frame beyond this share no camera is found."""

NOTE = "masks.json"


def digest(folder: Path, inverted: bool) -> str:
    """Return a hash of the masks in ``folder``.

    Raises:
        DataError: there are none.
    """
    found = hashlib.sha256(str(inverted).encode())
    for path in _listed(folder):
        found.update(path.name.encode() + b"\0" + path.read_bytes())
    return found.hexdigest()


def _listed(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise DataError(f"{folder}: is no folder; --masks takes a folder of pictures")
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES and p.is_file())
    if not files:
        raise DataError(f"{folder}: holds no masks; their names end in one of {' '.join(PICTURES)}")
    return files


def write_given_masks(
    folder: Path,
    given: Path,
    inverted: bool,
    source: Source,
    frames: Frames,
    on_progress: OnProgress,
) -> None:
    """Write the masks of the frames, in their size, from a folder of masks that a user gives.

    The mask of ``p.jpg`` is ``p.png`` or ``p.jpg.png``; the name of that of a video's frame
    ends in its number, counted from 0. Where there is none, nothing moves.

    Args:
        folder: to write.
        given: pictures, white where something moves.
        inverted: whether black is what moves instead.
        source: where the frames come from.
        frames: the chosen ones.
        on_progress: called with how many are done, and of how many.

    Raises:
        DataError: a mask cannot be read or has another size, or no frame has one.
    """
    listed = _listed(given)
    if frames.of_pictures:
        known = {name: path for path in listed for name in (Path(path.stem).stem, path.stem)}
    else:
        numbers = ((re.search(r"(\d+)\D*$", path.stem), path) for path in listed)
        known = {str(int(match[1])): path for match, path in numbers if match}
    originals = {path.name: path for path in source.files}
    missing = []
    for done, (name, frame) in enumerate(zip(frames.names, frames.taken, strict=True), start=1):
        path = known.get(Path(frame.file).stem if frames.of_pictures else str(frame.index))
        if path is None:
            missing.append(frame.file if frames.of_pictures else f"{frame.file} {frame.index}")
            moving = np.zeros(frames.size[::-1], bool)
        else:
            moving = _read(path, inverted, frames, originals[frame.file])
        write_mask(folder / name, moving)
        on_progress(done, len(frames.names))
    if len(missing) == len(frames.names):
        raise DataError(
            f"{given}: no mask has the name of a frame; that of {_wanted(frames, frames.taken[0])}"
        )
    write_json(folder / NOTE, {"missing": missing})


def _wanted(frames: Frames, frame: Candidate) -> str:
    if frames.of_pictures:
        return f"{frame.file} would be {Path(frame.file).stem}.png"
    return f"frame {frame.index} would be {frame.index:05d}.png"


def _read(path: Path, inverted: bool, frames: Frames, original: Path) -> Mask:
    """Return a mask in the frames' size, (H, W)."""
    picture = read_image(path, IN_CAPTURES)
    if frames.of_pictures:
        picture = upright(picture, read_exif(original).orientation)
    height, width, channels = picture.shape
    if (width, height) not in (frames.size, frames.original_size):
        sizes = {"{} x {}".format(*size) for size in (frames.original_size, frames.size)}
        raise DataError(
            f"mask {path} is {width} x {height} px; masks must be of their pictures' size, "
            f"{' or '.join(sorted(sizes))}"
        )
    grey = picture[..., : min(channels, 3)].max(axis=2)
    small = cv2.resize(grey, frames.size, interpolation=cv2.INTER_AREA)
    white = np.asarray(small) >= 128
    return ~white if inverted else white


def write_mask(path: Path, moving: Mask, size: tuple[int, int] | None = None) -> None:
    """Write an (H, W) mask as a picture, white where it is true; enlarged to (width, height)."""
    if size is not None:
        large = cv2.resize(moving.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        moving = np.asarray(large) > 0
    write_png(path, np.where(moving, 255, 0).astype(np.uint8)[..., None])


def read_mask(path: Path) -> Mask:
    """Return the (H, W) mask that ``write_mask`` has written."""
    return np.asarray(read_image(path)[..., 0] >= 128, dtype=np.bool_)


def require_room(folder: Path, frames: Frames, remedy: str) -> None:
    """Raise DataError if masks leave hardly anything of most frames to find cameras from.

    Args:
        folder: of the frames' masks.
        frames: that they are of.
        remedy: what to do about it.
    """
    covered = [bool(read_mask(folder / name).mean() > COVERED) for name in frames.names]
    if 2 * sum(covered) > len(covered):
        raise DataError(
            f"masks cover more than {100 * COVERED:.0f} % of {sum(covered)} of {len(covered)} "
            f"frames, so nothing is left to find cameras from: {remedy}"
        )


def standing(features: Features, moving: Mask) -> Features:
    """Return the features that are not on, or at the edge of, what moves."""
    height, width = moving.shape
    radius = max(2, round(MARGIN * max(width, height)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    grown = cv2.dilate(moving.astype(np.uint8), disc)
    columns = features.pixels[:, 0].astype(np.int64).clip(0, width - 1)
    rows = features.pixels[:, 1].astype(np.int64).clip(0, height - 1)
    return features.where(np.asarray(grown)[rows, columns] == 0)


def standing_features(features: Path, masks: Path | None, name: str) -> Features:
    """Return the features of the frame ``name``, of those on what moves none.

    COLMAP's database has these, in this order, and so do the images of its models.

    Args:
        features: folder of the frames' features.
        masks: folder of their masks, None if nothing moves.
        name: of the frame's file.
    """
    found = read_features(features, name)
    return found if masks is None else standing(found, read_mask(masks / name))
