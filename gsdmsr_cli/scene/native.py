"""OpenCV, OpenImageIO, pycolmap and PyAV, imported in the one order in which they get along.

pycolmap exports zlib and png symbols of its own, and loading it before cv2 makes every later PNG
write abort the process. So whoever needs one of them takes it from here.
"""

from __future__ import annotations

from typing import Any

import cv2 as cv2
import OpenImageIO as OpenImageIO


def load_pycolmap() -> Any:
    """Return pycolmap, set to log errors only."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    return pycolmap


def load_av() -> Any:
    """Return PyAV, whose libraries are loaded only for those who read or write videos."""
    import av

    return av
