"""The pictures that training and evaluation compare with, decoded once and kept in memory."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli import imaging
from gsdmsr_cli.camera import Camera
from gsdmsr_cli.errors import DataError, UsageError
from gsdmsr_cli.lens import Lens
from gsdmsr_cli.scene import View

_Key = tuple[Path, int, int, Lens | None, bool]


class Pictures:
    """A lazy cache of pictures over one background at one scale; safe to use from any thread.

    Compositing and shrinking are done in float and rounded once, to 8 bits (METHODS 0.11).

    Args:
        background: colour in [0, 1] behind straight alpha.
        downscale: both sides are divided by this, 1 or more.
        limit_bytes: memory for decoded pictures; beyond it the least recently used ones go.
    """

    def __init__(
        self, background: tuple[float, float, float], downscale: int, limit_bytes: int
    ) -> None:
        if downscale < 1:
            raise ValueError(f"downscale is {downscale}, not 1 or more")
        self._background = background
        self._downscale = downscale
        self._limit = limit_bytes
        self._held = 0
        self._cache: OrderedDict[_Key, Tensor] = OrderedDict()
        self._lock = threading.Lock()

    def over(self, background: tuple[float, float, float]) -> Pictures:
        """Return an empty cache of the same pictures over another background."""
        return Pictures(background, self._downscale, self._limit)

    def camera(self, view: View) -> Camera:
        """Return the camera of the picture that ``load`` returns.

        Raises:
            UsageError: the pictures are too small to be divided by ``downscale``.
        """
        return view.camera.resized(*self._size(view))

    def load(self, view: View) -> Tensor:
        """Return the view's picture, (3, h, w) uint8, contiguous; shared, so not to be changed.

        Raises:
            DataError: the file cannot be read or has another size than the view's camera.
            UsageError: as ``camera``.
        """
        return self._cached(view, view.image_path)

    def counted(self, view: View) -> Tensor | None:
        """Return which pixels of the view's picture count, (h, w) bool, or None for all.

        Raises:
            DataError, UsageError: as ``load``.
        """
        return self._mask(view, view.mask_path)

    def moving(self, view: View) -> Tensor | None:
        """Return which pixels of the view's picture move, (h, w) bool, or None if that is unknown.

        Raises:
            DataError, UsageError: as ``load``.
        """
        return self._mask(view, view.moving_path)

    def _mask(self, view: View, path: Path | None) -> Tensor | None:
        return None if path is None else self._cached(view, path, is_mask=True)

    def _cached(self, view: View, path: Path, is_mask: bool = False) -> Tensor:
        key = (path, view.camera.width, view.camera.height, view.lens, is_mask)
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        # Decoded outside the lock: two threads may decode the same picture, but none waits.
        picture = (self._decode_mask if is_mask else self._decode)(view, path)
        with self._lock:
            if key not in self._cache:
                self._cache[key] = picture
                self._held += picture.numel()
            self._cache.move_to_end(key)
            while self._held > self._limit:
                self._held -= self._cache.popitem(last=False)[1].numel()
        return picture

    def preload(
        self, views: Iterable[View], progress: Callable[[int, int], None] | None = None
    ) -> None:
        """Decode the views in order, on a few threads, as far as the memory limit goes.

        Args:
            views: the pictures wanted first.
            progress: called with (done, total) after each picture.

        Raises:
            DataError, UsageError: as ``load``.
        """
        views = list(views)
        ends = accumulate(3 * width * height for width, height in map(self._size, views))
        views = views[: sum(end <= self._limit for end in ends)]
        with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
            for done, _ in enumerate(pool.map(self.load, views), start=1):
                if progress is not None:
                    progress(done, len(views))

    def _size(self, view: View) -> tuple[int, int]:
        width, height = view.camera.width, view.camera.height
        if self._downscale > min(width, height):
            raise UsageError(
                f"downscale {self._downscale} leaves nothing of pictures of {width} x {height} px, "
                f"such as {view.image_path}; allowed: 1 to {min(width, height)}"
            )
        return round(width / self._downscale), round(height / self._downscale)

    def _decode(self, view: View, path: Path) -> Tensor:
        image = _read(view, path)
        size = self._size(view) if self._downscale > 1 else None
        if view.lens is None:
            return _planes(imaging.composite(image, self._background, size) * 255)
        pixels = imaging.resample(imaging.composite(image, self._background), *_sources(view.lens))
        return _planes((pixels if size is None else imaging.resize_area(pixels, *size)) * 255)

    def _decode_mask(self, view: View, path: Path) -> Tensor:
        """Return where a mask is white, or shows white in at least half of a shrunk pixel."""
        image = _read(view, path)
        values = image[..., : 3 if image.shape[2] > 3 else None].max(axis=2)
        # masks of 0 and 1 are common as well
        white = (values > (127 if values.max() > 1 else 0)).astype(np.float32)
        if view.lens is not None:
            white = imaging.resample(white, *_sources(view.lens), sharply=False)
        if self._downscale > 1:
            white = imaging.resize_area(white, *self._size(view))
        return torch.from_numpy(white >= 0.5)


class HalvedPictures:
    """The same pictures at half the size, for the early part of a training.

    Made from the cached pictures rather than the files, and kept beside them: a quarter of their
    memory, which the limit of the cache does not count.
    """

    def __init__(self, pictures: Pictures) -> None:
        self._pictures = pictures
        self._halved: dict[tuple[str, str], Tensor] = {}

    def camera(self, view: View) -> Camera:
        """Return the camera of the picture that ``load`` returns."""
        camera = self._pictures.camera(view)
        return camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))

    def counted(self, view: View) -> Tensor | None:
        """Return which pixels count, (h, w) bool: those of which at least half does; None for all.

        Made anew each time, which takes less than drawing the picture.
        """
        counted = self._pictures.counted(view)
        if counted is None:
            return None
        camera = self.camera(view)
        whole = counted.numpy().astype(np.float32)
        return torch.from_numpy(imaging.resize_area(whole, camera.width, camera.height) >= 0.5)

    def load(self, view: View) -> Tensor:
        """Return the view's picture, (3, h, w) uint8, averaged by area."""
        key = view.split, view.name
        if key not in self._halved:
            camera = self.camera(view)
            whole = self._pictures.load(view).permute(1, 2, 0).numpy().astype(np.float32)
            self._halved[key] = _planes(imaging.resize_area(whole, camera.width, camera.height))
        return self._halved[key]


def _read(view: View, path: Path) -> NDArray[np.uint8]:
    """Return the pixels of one of the view's files, which must have the size of its camera."""
    image = imaging.read_image(path)
    height, width, _ = image.shape
    if (width, height) != (view.camera.width, view.camera.height):
        raise DataError(
            f"image {path} is {width} x {height} px, but its camera is "
            f"{view.camera.width} x {view.camera.height}; they must agree"
        )
    return image


@lru_cache(maxsize=4)
def _sources(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return lens.sources()


class ResidentPictures:
    """Copies of pictures in the memory of a device, made when they are first asked for.

    Args:
        device: where; pictures that lie there already are passed on as they are.
        limit_bytes: memory for copies; what goes beyond it is copied every time.
    """

    def __init__(self, device: torch.device, limit_bytes: int) -> None:
        self._device, self._room = device, limit_bytes
        self._copies: dict[tuple[str, str, int, int], Tensor] = {}

    def load(self, pictures: Pictures | HalvedPictures, view: View) -> Tensor:
        """Return what ``pictures.load`` does, on the device.

        Raises:
            DataError: the file cannot be read.
        """
        if self._device.type == "cpu":
            return pictures.load(view)
        camera = pictures.camera(view)
        key = view.split, view.name, camera.width, camera.height
        if key in self._copies:
            return self._copies[key]
        copy = pictures.load(view).to(self._device)
        if copy.nbytes <= self._room:
            self._room -= copy.nbytes
            self._copies[key] = copy
        return copy


def _planes(pixels: NDArray[np.float32]) -> Tensor:
    """Return (H, W, 3) pixels in [0, 255] as (3, H, W) uint8."""
    planes = np.rint(pixels).clip(0, 255).astype(np.uint8).transpose(2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(planes))
