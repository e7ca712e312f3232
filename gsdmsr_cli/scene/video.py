"""The frames of a video file with the moments at which they are shown."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.native import cv2, load_av
from gsdmsr_cli.scene.picture_files import MOST_PIXELS, MOST_SIDE, PIXELS_PER_BYTE

Picture = NDArray[np.uint8]

CUT_SHORT = 0.95
"""A video is cut short if less than this share of its announced length can be decoded."""

MOST_FRAMES = 1_000_000
"""Of a video; nine hours at 30 a second."""

LONGEST_GAP = 60.0
"""A clock that jumps further ahead is damaged, unless frames are far apart anyway [s]."""

_FORMATS = "mov,matroska,webm,avi,mpegts,mpeg,mpegvideo,flv,ogg,asf,gif"
"""Containers, as FFmpeg names them. Others, such as lists of files, would open further files."""

ALLOWED = {"protocol_whitelist": "file", "format_whitelist": _FORMATS}
"""What FFmpeg is allowed when it opens a video."""

# read by OpenCV before it opens a video: what FFmpeg prints says nothing to a user
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
os.environ.setdefault(
    "OPENCV_FFMPEG_CAPTURE_OPTIONS", "|".join(f"{key};{value}" for key, value in ALLOWED.items())
)
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


def read_video(path: Path) -> Iterator[tuple[float, Picture]]:
    """Yield each frame's time from the first one [s] and its (H, W, 3) pixels, RGB and upright.

    Times are those in the file, so a variable frame rate is kept; they ascend strictly: where the
    clock jumps back, or further ahead than ``LONGEST_GAP``, it goes on from where it was. A
    rotation that a phone has noted is applied.

    Raises:
        DataError: the file is no video, is too large, changes its size, or less of it can be
            decoded than it announces.
    """
    capture = _open(path)
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    rate = _rate(capture)
    clock, count = _Clock(1 / rate), 0
    try:
        _require_one_size(path)
        while True:
            read, picture = capture.read()
            if not read:
                break
            clock.advance(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
            count += 1
            if count > MOST_FRAMES:
                raise DataError(f"{path}: has more than {MOST_FRAMES} frames; cut it")
            yield clock.time, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    finally:
        capture.release()
    _check_length(path, count, clock.time, announced, rate)


def video_length(path: Path) -> int:
    """Return how many frames the file announces; 0 if it does not say.

    Raises:
        DataError: the file is no video, or too large.
    """
    capture = _open(path)
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    capture.release()
    return int(announced) if 0 < announced <= MOST_FRAMES else 0


class _Clock:
    """Makes times that ascend strictly from what a file says of its frames.

    Attributes:
        time: of the last frame, from the first one [s].
    """

    def __init__(self, step: float) -> None:
        self.time = 0.0
        self._step = step
        self._zero: float | None = None

    def advance(self, stamp: float) -> None:
        """Go on to the next frame, of which the file says that it is shown at ``stamp`` [s]."""
        if self._zero is None:
            self._zero = stamp if math.isfinite(stamp) else 0.0
            return
        time = stamp - self._zero
        gap = max(LONGEST_GAP, 100 * self._step)
        if self.time < time <= self.time + gap:
            self._step, self.time = time - self.time, time
            return
        self.time += self._step
        if not -1 <= time - self.time <= gap and math.isfinite(stamp):
            self._zero = stamp - self.time  # another clock from here on


def _rate(capture: cv2.VideoCapture) -> float:
    """Return the announced frames a second, or 30 where that cannot be."""
    rate = float(capture.get(cv2.CAP_PROP_FPS))
    return rate if 1 <= rate <= 100_000 else 30.0


def _open(path: Path) -> cv2.VideoCapture:
    _require_bearable(path)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG) if path.is_file() else None
    if capture is None or not capture.isOpened():
        raise DataError(
            f"{path}: no video stream can be read from it: it is cut short, damaged or no video; "
            "copy it again or convert it to H.264 in .mp4"
        )
    size = [int(capture.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    if max(size) > MOST_SIDE or math.prod(size) > MOST_PIXELS:
        capture.release()
        raise DataError(
            f"{path}: is {size[0]} x {size[1]} px; allowed: up to {MOST_SIDE} px a side and "
            f"{MOST_PIXELS // 1_000_000} million pixels; convert it"
        )
    return capture


def _require_bearable(path: Path) -> None:
    """Raise DataError if the first picture is larger than the whole file can hold.

    OpenCV decodes it as soon as it opens a video, whatever memory that takes, and cannot be told
    of a bound; this one leaves the size unknown where it is exceeded.
    """
    av = load_av()
    try:
        size = path.stat().st_size
        most = min(PIXELS_PER_BYTE * size, MOST_PIXELS)
        with av.open(str(path), options=ALLOWED | {"max_pixels": str(most)}) as file:
            contexts = [stream.codec_context for stream in file.streams.video[:1]]
            sizes = [(c.width, c.height) for c in contexts if c is not None]  # of known codecs
    except (av.FFmpegError, OSError, ValueError, MemoryError):
        return  # OpenCV is asked next, and tells what it cannot open
    if (0, 0) in sizes:
        raise DataError(
            f"{path}: is damaged, or its pictures have more than {most} pixels, the most in a "
            f"video of {size} bytes; copy it again or convert it to H.264 in .mp4"
        )


def _require_one_size(path: Path) -> None:
    """Raise DataError if the pictures change their size, which OpenCV would hide by stretching."""
    about = path.stat()
    sizes = _sizes(path, about.st_mtime_ns, about.st_size)
    if len(sizes) > 1:
        shown = " and ".join(f"{width} x {height}" for width, height in sizes[:3])
        raise DataError(f"{path}: has frames of {shown} px; cut it where its size changes")


@lru_cache(maxsize=64)
def _sizes(path: Path, _modified: int, _length: int) -> list[tuple[int, int]]:
    """Return the sizes of the keyframes, at which alone a video can change; none if undecodable."""
    av = load_av()
    sizes: dict[tuple[int, int], None] = {}
    try:
        with av.open(str(path), options=ALLOWED) as file:
            file.streams.video[0].codec_context.skip_frame = "NONKEY"
            for frame in file.decode(video=0):
                sizes[frame.width, frame.height] = None
    except (av.FFmpegError, IndexError, ValueError, MemoryError):
        pass  # OpenCV is asked next, and tells what it can decode
    return list(sizes)


def _check_length(path: Path, count: int, last: float, announced: float, rate: float) -> None:
    if not count:
        raise DataError(f"{path}: none of its frames can be decoded; convert it to H.264 in .mp4")
    if not 0 < announced <= MOST_FRAMES:
        return
    length, found = announced / rate, last + 1 / rate
    # counted as frames or as seconds: one of the two is exact, whichever the container stores
    if max(found / length, count / announced) < CUT_SHORT:
        raise DataError(
            f"{path}: is cut short: {count} of {announced:.0f} frames can be decoded, {found:.1f} "
            f"of {length:.1f} s; copy it again"
        )
