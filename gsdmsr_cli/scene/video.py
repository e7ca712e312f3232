"""The frames of a video file with the moments at which they are shown."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.native import cv2

Picture = NDArray[np.uint8]

CUT_SHORT = 0.95
"""A video is cut short if less than this share of its announced length can be decoded."""

# read by OpenCV before it opens its first video: what FFmpeg prints says nothing to a user
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def read_video(path: Path) -> Iterator[tuple[float, Picture]]:
    """Yield each frame's time from the first one [s] and its (H, W, 3) pixels, RGB and upright.

    Times are those in the file, so a variable frame rate is kept; a rotation that a phone has
    noted is applied.

    Raises:
        DataError: the file is no video, or less of it can be decoded than it announces.
    """
    capture = _open(path)
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    rate = capture.get(cv2.CAP_PROP_FPS)
    first, last, count = 0.0, 0.0, 0
    try:
        while True:
            read, picture = capture.read()
            if not read:
                break
            time = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            if count == 0:
                first = time
            elif time - first <= last:  # a damaged time stamp; frames are in the order of time
                time = first + last + (1 / rate if rate > 0 else 1 / 30)
            last = time - first
            count += 1
            yield last, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
    finally:
        capture.release()
    _check_length(path, count, last, announced, rate)


def video_length(path: Path) -> int:
    """Return how many frames the file announces; 0 if it does not say.

    Raises:
        DataError: the file is no video.
    """
    capture = _open(path)
    announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
    capture.release()
    return max(int(announced), 0)


def _open(path: Path) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    if not capture.isOpened():
        raise DataError(
            f"{path}: no video stream can be read from it: it is cut short, damaged or no video; "
            "copy it again or convert it to H.264 in .mp4"
        )
    return capture


def _check_length(path: Path, count: int, last: float, announced: float, rate: float) -> None:
    if not count:
        raise DataError(f"{path}: none of its frames can be decoded; convert it to H.264 in .mp4")
    if announced <= 0 or rate <= 0:
        return
    length, found = announced / rate, last + 1 / rate
    # counted as frames or as seconds: one of the two is exact, whichever the container stores
    if max(found / length, count / announced) < CUT_SHORT:
        raise DataError(
            f"{path}: is cut short: {count} of {announced:.0f} frames can be decoded, {found:.1f} "
            f"of {length:.1f} s; copy it again"
        )
