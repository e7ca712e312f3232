"""Decodes the files of a view to tensors: its picture and its other signals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.scene import MASK, MOVING, View

Size = tuple[int, int]
"""Width and height [px]."""


@dataclass(frozen=True)
class Decoder:
    """How signals of one kind become tensors.

    Attributes:
        channels: sizes of the tensor before its height and width.
        dtype: of its elements.
        decode: returns the tensor of a view's file at a size.
        shrink: returns the tensor at a smaller size.
    """

    channels: tuple[int, ...]
    dtype: torch.dtype
    decode: Callable[[View, Path, Size], Tensor]
    shrink: Callable[[Tensor, Size], Tensor]


def decode_picture(view: View, size: Size, background: tuple[float, float, float]) -> Tensor:
    """Return the view's picture, (3, h, w) uint8, over a background of colours in [0, 1].

    Compositing and shrinking are done in float and rounded once, to 8 bits (METHODS 0.11).

    Raises:
        DataError: the file cannot be read or has another size than the view's camera.
    """
    image = _read(view, view.image_path)
    smaller = size if size != _own_size(view) else None
    if view.lens is None:
        return _planes(imaging.composite(image, background, smaller) * 255)
    pixels = imaging.resample(imaging.composite(image, background), *_sources(view.lens))
    return _planes((pixels if smaller is None else imaging.resize_area(pixels, *smaller)) * 255)


def shrink_picture(picture: Tensor, size: Size) -> Tensor:
    """Return a picture (3, H, W) uint8 averaged by area, (3, h, w) uint8."""
    pixels = picture.permute(1, 2, 0).numpy().astype(np.float32)
    return _planes(imaging.resize_area(pixels, *size))


def decode_mask(view: View, path: Path, size: Size) -> Tensor:
    """Return where a mask shows white in at least half of a pixel, (h, w) bool.

    Raises:
        DataError: the file cannot be read or has another size than the view's camera.
    """
    image = _read(view, path)
    values = image[..., : 3 if image.shape[2] > 3 else None].max(axis=2)
    # masks of 0 and 1 are common as well
    white = (values > (127 if values.max() > 1 else 0)).astype(np.float32)
    if view.lens is not None:
        white = imaging.resample(white, *_sources(view.lens), sharply=False)
    if size != _own_size(view):
        white = imaging.resize_area(white, *size)
    return torch.from_numpy(white >= 0.5)


def shrink_mask(mask: Tensor, size: Size) -> Tensor:
    """Return where at least half of the mask's pixels are white, (h, w) bool."""
    return torch.from_numpy(imaging.resize_area(mask.numpy().astype(np.float32), *size) >= 0.5)


_MASKS = Decoder((), torch.bool, decode_mask, shrink_mask)

DECODERS: Mapping[str, Decoder] = {MASK: _MASKS, MOVING: _MASKS}
"""Name of a signal to what decodes it."""


def _own_size(view: View) -> Size:
    return view.camera.width, view.camera.height


def _read(view: View, path: Path) -> NDArray[np.uint8]:
    """Return the pixels of one of the view's files, which must have the size of its camera."""
    image = imaging.read_image(path)
    height, width, _ = image.shape
    if (width, height) != _own_size(view):
        raise DataError(
            f"image {path} is {width} x {height} px, but its camera is "
            f"{view.camera.width} x {view.camera.height}; they must agree"
        )
    return image


@lru_cache(maxsize=4)
def _sources(lens: Lens) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    return lens.sources()


def _planes(pixels: NDArray[np.float32]) -> Tensor:
    """Return (H, W, 3) pixels in [0, 255] as (3, H, W) uint8."""
    planes = np.rint(pixels).clip(0, 255).astype(np.uint8).transpose(2, 0, 1)
    return torch.from_numpy(np.ascontiguousarray(planes))
