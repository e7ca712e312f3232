"""The pictures that training and evaluation compare with, decoded once and kept in memory."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.block_store import BlockStore
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.decoding import DECODERS, decode_picture, shrink_picture
from gsdmsr_cli.scene.scene import View


class Pictures:
    """A lazy cache of pictures and signals over one background at one scale.

    Safe to use from any thread, and from processes that are forked later: they share the cache.

    Args:
        background: colour in [0, 1] behind straight alpha.
        downscale: both sides are divided by this, 1 or more.
        limit_bytes: memory for decoded pictures, masks and halved pictures of all processes
            together; beyond it the least recently used ones go. What is returned is a copy, which
            the limit does not count.
    """

    def __init__(
        self, background: tuple[float, float, float], downscale: int, limit_bytes: int
    ) -> None:
        if downscale < 1:
            raise ValueError(f"downscale is {downscale}, not 1 or more")
        self._background = background
        self._downscale = downscale
        self.store = BlockStore(limit_bytes)

    def over(self, background: tuple[float, float, float]) -> Pictures:
        """Return the same pictures over another background, kept in the same memory."""
        other = copy.copy(self)
        other._background = background
        return other

    def camera(self, view: View) -> Camera:
        """Return the camera of the picture that ``load`` returns.

        Raises:
            UsageError: the pictures are too small to be divided by ``downscale``.
        """
        return view.camera.resized(*self._size(view))

    def load(self, view: View, keep: bool = True) -> Tensor:
        """Return the view's picture, (3, h, w) uint8, contiguous.

        Args:
            view: whose picture.
            keep: whether it is kept for later calls, if it has to be decoded now.

        Raises:
            DataError: the file cannot be read or has another size than the view's camera.
            UsageError: as ``camera``.
        """
        width, height = self._size(view)
        number = self.number("picture", view, view.image_path)
        shape = 3, height, width
        return self.cached(number, shape, torch.uint8, lambda: self.decode(view), keep)

    def signal(self, view: View, name: str) -> Tensor | None:
        """Return a signal of the view, or None if the view has none of this name.

        Masks are (h, w) bool. Its file is not opened before this is called.

        Raises:
            ValueError: nothing decodes signals of this name.
            DataError, UsageError: as ``load``.
        """
        if name not in DECODERS:
            raise ValueError(f"nothing decodes the signal {name!r}; known: {', '.join(DECODERS)}")
        path = view.signals.get(name)
        if path is None:
            return None
        decoder, (width, height) = DECODERS[name], self._size(view)
        shape = *decoder.channels, height, width
        return self.cached(
            self.number(name, view, path), shape, decoder.dtype,
            lambda: decoder.decode(view, path, (width, height)),
        )  # fmt: skip

    def decode(self, view: View) -> Tensor:
        """Return what ``load`` does, always from the file."""
        return decode_picture(view, self._size(view), self._background)

    def preload(self, views: Iterable[View], progress: OnProgress | None = None) -> None:
        """Decode the views in order, on a few threads, as far as the memory limit goes.

        Args:
            views: the pictures wanted first.
            progress: called with (done, total) after each picture.

        Raises:
            DataError, UsageError: as ``load``.
        """
        views = list(views)
        sizes = [3 * width * height for width, height in map(self._size, views)]
        views = views[: self.store.fitting(sizes)]
        with ThreadPoolExecutor(min(8, cores())) as pool:
            for done, _ in enumerate(pool.map(self.load, views), start=1):
                if progress is not None:
                    progress(done, len(views))

    def number(self, kind: str, view: View, path: Path) -> int:
        """Return the number under which the store keeps what is decoded from a view's file.

        It is equal in all processes, and differs for all that decodes differently.
        """
        size = view.camera.width, view.camera.height
        key = kind, path, size, view.lens, self._downscale, self._background
        digest = blake2b(repr(key).encode(), digest_size=8).digest()
        return int.from_bytes(digest, "little", signed=True) or 1

    def cached(
        self,
        number: int,
        shape: tuple[int, ...],
        dtype: torch.dtype,
        make: Callable[[], Tensor],
        keep: bool = True,
    ) -> Tensor:
        """Return the tensor that the store has under a number, or else what ``make`` returns.

        Args:
            number: see ``number``.
            shape, dtype: of the tensor.
            make: called without any lock, so several threads may make the same, but none waits.
            keep: whether the store is to keep what has been made.
        """
        found = self.store.get(number, math.prod(shape) * dtype.itemsize)
        if found is not None:
            return torch.from_numpy(found).view(dtype).view(shape)
        made = make()
        if keep:
            self.store.put(number, made.numpy().reshape(-1).view(np.uint8))
        return made

    def _size(self, view: View) -> tuple[int, int]:
        width, height = view.camera.width, view.camera.height
        if self._downscale > min(width, height):
            raise UsageError(
                f"downscale {self._downscale} leaves nothing of pictures of {width} x {height} px, "
                f"such as {view.image_path}; allowed: 1 to {min(width, height)}"
            )
        return round(width / self._downscale), round(height / self._downscale)


class HalvedPictures:
    """The same pictures at half the size, for the early part of a training.

    Kept in the same memory and within the same limit until ``release``. Where a whole picture has
    to be decoded for its half, only the half is kept.
    """

    def __init__(self, pictures: Pictures) -> None:
        self._pictures = pictures
        self._used: set[int] = set()

    def camera(self, view: View) -> Camera:
        """Return the camera of the picture that ``load`` returns."""
        camera = self._pictures.camera(view)
        return camera.resized(max(1, camera.width // 2), max(1, camera.height // 2))

    def signal(self, view: View, name: str) -> Tensor | None:
        """Return what ``Pictures.signal`` does, at half the size.

        Made from the whole one each time, which takes less than drawing the picture.
        """
        whole = self._pictures.signal(view, name)
        if whole is None:
            return None
        camera = self.camera(view)
        return DECODERS[name].shrink(whole, (camera.width, camera.height))

    def load(self, view: View) -> Tensor:
        """Return the view's picture, (3, h, w) uint8, averaged by area."""
        camera = self.camera(view)
        size = camera.width, camera.height
        number = self._pictures.number("halved", view, view.image_path)
        self._used.add(number)
        return self._pictures.cached(
            number, (3, camera.height, camera.width), torch.uint8,
            lambda: shrink_picture(self._pictures.load(view, keep=False), size),
        )  # fmt: skip

    def release(self) -> None:
        """Return the memory of all halved pictures that this process has loaded."""
        if self._used:
            self._pictures.store.drop(self._used)
            self._used.clear()


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
