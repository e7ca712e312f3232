"""Decodes the videos of a data set to pictures, once: into its folder or where the user says."""

from __future__ import annotations

import os
import re
import shutil
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import can_be_written
from gsdmsr_cli.ground.locks import in_turn
from gsdmsr_cli.ground.machine import cache_home
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene import picture_hashes
from gsdmsr_cli.scene.imaging import resize_area, write_png
from gsdmsr_cli.scene.video import read_video, video_length

FOLDER_VARIABLE = "GSDMSR_FRAMES_DIR"
"""Environment variable that names the folder for decoded frames of all data sets."""

_ELSEWHERE = (
    f"frames of videos are decoded there, once; name a folder for them in {FOLDER_VARIABLE}, or "
    "write a scene folder with gsdmsr prepare"
)
"""What to do where the frames of videos cannot be written."""

_UNEVEN = 0.25
"""By how much of a step, at most, times of evenly spaced frames are off."""

_PART = ".part"
_STALE = re.compile(rf"\.images\.[0-9a-f]{{32}}{re.escape(_PART)}")
"""What a killed process leaves of a video that it was decoding."""


def kept_frames() -> Path:
    """Return the folder for frames of data sets that cannot be written, a folder for each."""
    return cache_home() / "frames"


def place_of_frames(folder: Path, videos: Sequence[Path]) -> Path:
    """Return the folder in which the frames of a data set lie, or are to lie.

    The folder that ``GSDMSR_FRAMES_DIR`` names comes first, then the data set's own, and one of the
    cache where that cannot be written. Other than in the data set, a folder's name is a hash of
    samples of the videos, so that changed ones are decoded anew.

    Args:
        folder: of the data set.
        videos: in it, those that have no frames there.

    Raises:
        DataError: a video cannot be read.
    """
    if not videos:
        return folder
    named = os.environ.get(FOLDER_VARIABLE)
    own = all(can_be_written(video.with_suffix("")) for video in videos)
    if not named and own:
        return folder
    above = Path(named) if named else kept_frames()
    return above / picture_hashes.digest(picture_hashes.sampled(folder, videos))


def frames_of(place: Path, camera: str) -> Path:
    """Return the folder of a camera's frames."""
    return place / camera / "images"


def decode_videos(
    folder: Path, videos: Sequence[Path], place: Path, halved_from: int, on_progress: OnProgress
) -> None:
    """Decode videos whose frames are not there yet, each to all of its frames or none.

    Where some are broken, the others are decoded all the same. Frames are named by their numbers,
    from 0; where a video has lost frames, by its times, their numbers are left out.

    Args:
        folder: of the data set.
        videos: to decode.
        place: see ``place_of_frames``.
        halved_from: pictures as wide as this are halved [px].
        on_progress: called with the frames decoded, and of how many.

    Raises:
        DataError: videos cannot be decoded, or a frame not be written.
    """
    wanted = [video for video in videos if not frames_of(place, video.stem).is_dir()]
    if wanted and place.parent == kept_frames():
        say.note(
            f"{folder} cannot be written, so its videos are decoded into {place}; "
            f"{FOLDER_VARIABLE} would name another folder"
        )
    done, total = 0, sum(map(_length, wanted))

    def count() -> None:
        nonlocal done
        done += 1
        on_progress(done, max(done, total))

    broken = []
    for video in wanted:
        try:
            _decode(video, frames_of(place, video.stem), halved_from, count)
        except DataError as error:
            if not str(error).startswith(f"{video}: "):
                raise  # it is no fault of the video
            broken.append(error)
    if broken:
        others = f"; so are {len(broken) - 1} more" if len(broken) > 1 else ""
        names = "".join(f", {str(error).partition(': ')[0]}" for error in broken[1:])
        raise DataError(f"{broken[0]}{others}{names}; frames of the other videos are kept")


def _length(video: Path) -> int:
    """Return how many frames a video announces, 0 if it cannot be opened."""
    try:
        return video_length(video)
    except DataError:
        return 0


def _decode(video: Path, target: Path, halved_from: int, count: Callable[[], None]) -> None:
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
            times = []
            for i, (time, picture) in enumerate(read_video(video)):
                write_png(beside / f"{i:04d}.png", _halved(picture, halved_from))
                times.append(time)
                count()
            for i, number in reversed([*enumerate(numbers_of(times))]):
                if number > i:
                    (beside / f"{i:04d}.png").rename(beside / f"{number:04d}.png")
            beside.replace(target)
        except OSError as error:
            reason = error.strerror or error
            raise DataError(
                f"{target}: cannot be written: {reason}; free space, or name another folder in "
                f"{FOLDER_VARIABLE} or as the --out of gsdmsr prepare"
            ) from error
        finally:
            shutil.rmtree(beside, ignore_errors=True)


def numbers_of(times: Sequence[float]) -> list[int]:
    """Return the numbers of frames, between which some are left out where frames have been lost.

    Args:
        times: of the frames, ascending [s]. Unless they lie at multiples of one step, nearly, it is
            not known what has been lost, and the numbers are 0, 1, 2 and so on.
    """
    steps = np.diff(times)
    plain = list(range(len(times)))
    if not len(steps):
        return plain
    multiples = steps / float(np.median(steps))
    whole = np.rint(multiples)
    if whole.min() < 1 or float(np.abs(multiples - whole).max()) > _UNEVEN:
        return plain
    return [0, *whole.astype(int).cumsum().tolist()]


def _halved(picture: NDArray[np.uint8], halved_from: int) -> NDArray[np.uint8]:
    height, width, _ = picture.shape
    if width < halved_from:
        return picture
    small = resize_area(picture.astype(np.float32), width // 2, height // 2)
    return np.rint(small).astype(np.uint8)
