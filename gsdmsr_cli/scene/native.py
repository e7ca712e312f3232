"""OpenCV, OpenImageIO, pycolmap and PyAV, imported in the one order in which they get along.

pycolmap exports zlib and png symbols of its own, and loading it before cv2 makes every later PNG
write abort the process. So whoever needs one of them takes it from here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import cv2 as cv2
import OpenImageIO as OpenImageIO


@contextlib.contextmanager
def one_opencv_thread() -> Iterator[None]:
    """Let OpenCV use one thread meanwhile.

    What it finds may depend on the number of its threads. And these do not come along into a
    process that is forked: there it would wait for them for ever, even to change their number.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def load_pycolmap() -> Any:
    """Return pycolmap, set to log errors only."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    return pycolmap


def load_av() -> Any:
    """Return PyAV, whose libraries are loaded only for those who read or write videos."""
    import av

    return av
