"""Reads and writes pictures, and scales, composites and colours their pixels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.scene.native import OpenImageIO, cv2
from gsdmsr_cli.scene.picture_files import IN_SCENES, opened, unreadable

_PNG_SETTINGS = (
    cv2.IMWRITE_PNG_COMPRESSION, 1,
    cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP,
    cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE,
)  # fmt: skip

_LOSSLESS = 101
"""A quality of WebP pictures above 100 leaves all as it is."""


def read_image(path: Path, kinds: tuple[str, ...] = IN_SCENES) -> NDArray[np.uint8]:
    """Return the pixels of ``path``, (H, W, C) with C = 1 (grey), 3 (RGB) or 4 (RGBA).

    Alpha is straight (unassociated), exactly as stored; 16-bit files are scaled to 8 bits. Grey
    with alpha becomes RGBA. An orientation tag is ignored: cameras refer to pixels as stored.

    Args:
        path: of the file, whose content decides what it is, not its name.
        kinds: of files that are taken, see ``picture_files``.

    Raises:
        DataError: the file is missing, truncated, damaged, not such a picture, or too large.
    """
    with opened(path, kinds, thorough=True) as source:
        pixels = source.read_image(OpenImageIO.UINT8)
        # A truncated JPEG decodes with its missing rows in grey and says so only in the error text.
        message = source.geterror()
    if pixels is None or message:
        raise DataError(unreadable(path, message))
    if pixels.shape[2] == 2:
        pixels = pixels[..., [0, 0, 0, 1]]
    return np.ascontiguousarray(pixels)


def image_size(path: Path, kinds: tuple[str, ...] = IN_SCENES) -> tuple[int, int]:
    """Return (width, height) [px] of ``path`` without decoding its pixels; ``kinds`` as above.

    Raises:
        DataError: the file is missing, no such picture, too large, or is a PNG without an end.
    """
    with opened(path, kinds) as source:
        spec = source.spec()
        return spec.width, spec.height


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write (H, W, 1 | 3 | 4) pixels, grey, RGB or straight RGBA, as a PNG, whole or not at all.

    Compressed by rows' differences and runs of bytes: half the time of OpenCV's usual settings, and
    smaller files where there are plain backgrounds.

    Raises:
        DataError: the file cannot be written, for example because the disk is full.
    """
    swap = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}.get(image.shape[2])
    ordered = image if swap is None else cv2.cvtColor(image, swap)
    encoded = cv2.imencode(".png", ordered, _PNG_SETTINGS)[1]
    with replacing(path, durable=False) as temporary:
        temporary.write_bytes(encoded.tobytes())


def encode_lossless_webp(pixels: NDArray[np.uint8]) -> bytes:
    """Return a WebP file of (H, W, 3 or 4) RGB or RGBA bytes, which reads back byte by byte.

    Colours under alpha 0 are not kept: there may be none.
    """
    order = [2, 1, 0, 3][: pixels.shape[2]]
    ordered = np.ascontiguousarray(pixels[..., order])
    return cv2.imencode(".webp", ordered, (cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS))[1].tobytes()


def encode_webp(image: NDArray[np.uint8], quality: int) -> bytes:
    """Return (H, W, 3) RGB pixels as a lossy WebP picture; the quality is 1 to 100."""
    ordered = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".webp", ordered, (cv2.IMWRITE_WEBP_QUALITY, quality))[1].tobytes()


def write_exr(path: Path, image: NDArray[np.float32], channels: tuple[str, ...]) -> None:
    """Write (H, W, C) numbers as a float32 OpenEXR file, exactly, whole or not at all.

    Raises:
        DataError: the file cannot be written, for example because the disk is full.
    """
    height, width, count = image.shape
    spec = OpenImageIO.ImageSpec(width, height, count, OpenImageIO.FLOAT)
    spec.channelnames = channels
    spec["compression"] = "zips"
    with replacing(path, durable=False) as temporary:
        temporary.touch()  # says why a file cannot be opened, which OpenImageIO does not
        out = OpenImageIO.ImageOutput.create(str(temporary))
        if out is None:
            raise GsdmsrError(f"OpenImageIO cannot write EXR ({OpenImageIO.geterror()})")
        opened = out.open(str(temporary), spec)
        if not (opened and out.write_image(np.ascontiguousarray(image)) and out.close()):
            raise OSError(" ".join(out.geterror().split()) or "unknown reason")
        _require_last_row(temporary)


def _require_last_row(path: Path) -> None:
    """Raise OSError if the end of a file that was written is not there.

    OpenImageIO does not tell that the last bytes, which wait until the file is closed, are lost.
    """
    source = OpenImageIO.ImageInput.open(str(path))
    if source is None:
        raise OSError("it was cut short")
    spec = source.spec()
    last = spec.height - 1, spec.height, 0, 0, spec.nchannels
    row = source.read_scanlines(*last, OpenImageIO.FLOAT)
    whole = row is not None and not source.geterror()
    source.close()
    if not whole:
        raise OSError("it was cut short")


def read_exr(path: Path) -> tuple[NDArray[np.float32], tuple[str, ...]]:
    """Return the (H, W, C) numbers of ``path`` and the names of its channels.

    Raises:
        DataError: the file is missing or damaged.
    """
    with opened(path, ("openexr",)) as source:
        spec, pixels = source.spec(), source.read_image(OpenImageIO.FLOAT)
        message = source.geterror()
    if pixels is None or message:
        raise DataError(unreadable(path, message))
    return pixels, tuple(spec.channelnames)


def eight_bits(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (H, W, C) numbers, clamped to [0, 1], as whole steps of 1 / 255; NaN becomes 0."""
    # each plane by itself: engines draw planes, and whole rows are faster than strided pixels
    planes = [image[..., channel] * np.float32(255) for channel in range(image.shape[2])]
    rounded = [cv2.addWeighted(plane, 1, plane, 0, 0, dtype=cv2.CV_8U) for plane in planes]
    return np.asarray(cv2.merge(rounded), dtype=np.uint8).reshape(image.shape)


def turbo(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (H, W) numbers as (H, W, 3) colours, from dark blue at 0 to dark red at 1 (Turbo)."""
    grey = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    coloured = cv2.applyColorMap(grey, cv2.COLORMAP_TURBO)
    return np.asarray(cv2.cvtColor(coloured, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def colour_wheel(vectors: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return (H, W, 2) vectors x, y as (H, W, 3) colours.

    The hue is the direction: red to the right, then yellow, green (120 degrees), blue, clockwise
    on the screen, whose y points down; the saturation is the length, white for 0 to full for 1.
    """
    length, angle = cv2.cartToPolar(
        np.ascontiguousarray(vectors[..., 0]),
        np.ascontiguousarray(vectors[..., 1]),
        angleInDegrees=True,
    )
    value = np.ones_like(length)
    hsv = cv2.merge([angle % 360, np.minimum(length, 1), value])
    rgb = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)
    return np.rint(rgb * 255).astype(np.uint8)


def composite(
    image: NDArray[np.uint8],
    background: tuple[float, float, float],
    size: tuple[int, int] | None = None,
) -> NDArray[np.float32]:
    """Return (H, W, 1 | 3 | 4) straight-alpha pixels over ``background``, (H, W, 3) in [0, 1].

    With a ``size`` (width, height) the picture is shrunk to it, see ``resize_area``. Colours are
    weighted by alpha before that; the background, equal everywhere, joins afterwards, which comes
    to the same and is less work.
    """
    # Whole planes are four times as fast as strided RGBA.
    full, split = np.float32(255), cv2.split(image)
    if len(split) < 4:
        planes = [_shrunk(plane / full, size) for plane in split] * (3 // len(split))
    else:
        *colours, opacity = split
        alpha = opacity / full
        weight, rest = alpha / full, 1 - _shrunk(alpha, size)
        planes = [
            _shrunk(colour * weight, size) + rest * np.float32(behind)
            for colour, behind in zip(colours, background, strict=True)
        ]
    return np.asarray(cv2.merge(planes), dtype=np.float32)


def _shrunk(plane: NDArray[np.float32], size: tuple[int, int] | None) -> NDArray[np.float32]:
    return plane if size is None else resize_area(plane, *size)


def resize_area(image: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Return (H, W) or (H, W, C) pixels, shrunk; each is the mean of the area it covers."""
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(resized, dtype=np.float32)


def resample(
    image: NDArray[np.float32],
    columns: NDArray[np.float32],
    rows: NDArray[np.float32],
    sharply: bool = True,
) -> NDArray[np.float32]:
    """Return (H, W) or (H, W, C) pixels, each taken from a place of ``image`` between its pixels.

    Args:
        columns, rows: (H, W) places, counted from the centre of the first pixel; what lies beyond
            the border is as the border.
        sharply: cubic interpolation, which may overshoot a little; else linear.
    """
    how = cv2.INTER_CUBIC if sharply else cv2.INTER_LINEAR
    taken = cv2.remap(image, columns, rows, how, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(taken, dtype=np.float32)
