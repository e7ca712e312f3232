"""How pictures say that things have moved: optical flow between two views, kept in files."""

from __future__ import annotations

import contextlib
import zlib
from hashlib import blake2b
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.scene.native import cv2, one_opencv_thread
from gsdmsr_cli.scene.optical_flow import Floats32, Grey, optical_flow, trusted
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.scene.scene import View

INCONSISTENT = 1.0
"""Flow there and back that ends so far from its start is not to be trusted [px]."""

STEPS = 16
"""Flow is kept in this many steps a pixel: what stands still then takes hardly any room."""

SMALLEST = 32
"""Shortest side of pictures that have a flow [px]."""


class PicturedFlow:
    """Flow between pictures, computed when it is first asked for.

    Attributes:
        folder: where it is kept for later, as files named by what is in the pictures; None keeps
            nothing.
    """

    def __init__(self) -> None:
        self.folder: Path | None = None
        self._names: dict[tuple[View, View, int], str] = {}

    def between(self, pictures: Pictures | HalvedPictures, view: View, other: View) -> Floats32:
        """Return (H, W, 2) from a view's picture to another's [px], NaN where it is not trusted.

        Raises:
            DataError: a picture cannot be read.
        """
        camera = pictures.camera(view)
        if min(camera.width, camera.height) < SMALLEST:
            return np.full((camera.height, camera.width, 2), np.nan, np.float32)
        key = view, other, camera.width
        if self.folder is not None and key in self._names:
            found = _read(self.folder / self._names[key], (camera.height, camera.width, 2))
            if found is not None:
                return found
        here, there = pictures.load(view), pictures.load(other)
        self._names[key] = f"{_digest(here, there)}.npz"
        path = None if self.folder is None else self.folder / self._names[key]
        found = None if path is None else _read(path, (camera.height, camera.width, 2))
        if found is None:
            found = _consistent_flow(_grey(here), _grey(there))
            if path is not None:
                _write(path, found)
        return found


def _digest(here: Tensor, there: Tensor) -> str:
    """Return a name for two pictures, by their pixels."""
    hashed = blake2b(repr((tuple(here.shape), INCONSISTENT)).encode(), digest_size=16)
    for picture in (here, there):
        hashed.update(picture.numpy().tobytes())
    return hashed.hexdigest()


def _grey(picture: Tensor) -> Grey:
    pixels = np.ascontiguousarray(picture.permute(1, 2, 0).numpy())
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)


def _consistent_flow(here: Grey, there: Grey) -> Floats32:
    """Return the flow as precisely as it is kept, so that first and later uses agree."""
    with one_opencv_thread():
        forward, back = optical_flow(here, there), optical_flow(there, here)
        sure = trusted(forward, back, INCONSISTENT)
    rounded = (forward * STEPS).round() / STEPS
    return np.where(sure[..., None], rounded, np.nan).astype(np.float16).astype(np.float32)


def _read(path: Path, shape: tuple[int, ...]) -> Floats32 | None:
    """Return the flow in a file, or None if it is not there, damaged or of another shape."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            found = arrays["flow"]
    except (OSError, ValueError, EOFError, KeyError, BadZipFile, zlib.error):
        return None
    fits = found.shape == shape and found.dtype == np.float16
    return np.asarray(found, np.float32) if fits else None


def _write(path: Path, flow: Floats32) -> None:
    """Keep a flow; a disk that does not take it costs time later, and nothing else."""
    with contextlib.suppress(OSError, DataError):
        path.parent.mkdir(exist_ok=True)
        with replacing(path, durable=False) as beside:
            np.savez_compressed(beside, flow=flow.astype(np.float16))
