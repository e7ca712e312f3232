"""Opens picture files that are what they seem: known by content, of a bearable size, undamaged."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.native import OpenImageIO

IN_SCENES = ("png", "jpeg")
"""Kinds of the pictures of scenes and runs."""

IN_CAPTURES = (*IN_SCENES, "tiff", "bmp", "webp")
"""Kinds of the pictures that ``gsdmsr prepare`` takes."""

MOST_SIDE, MOST_PIXELS = 16384, 256_000_000
"""Larger pictures are refused: no camera takes them, and decoding takes several bytes a pixel."""

_SIGNATURES = {
    b"\x89PNG\r\n\x1a\n": "png",
    b"\xff\xd8\xff": "jpeg",
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"BM": "bmp",
    b"RIFF": "webp",
    b"\x76\x2f\x31\x01": "openexr",
}

_SUFFIXES = {
    "png": (".png",), "jpeg": (".jpg", ".jpeg"), "tiff": (".tif", ".tiff"), "bmp": (".bmp",),
    "webp": (".webp",), "openexr": (".exr",),
}  # fmt: skip

PIXELS_PER_BYTE = 8 * 1032
"""More than this a byte cannot hold: of one bit, deflated. Few kinds of compression reach more."""

_MOST_PER_BYTE = {
    "png": PIXELS_PER_BYTE, "jpeg": PIXELS_PER_BYTE, "bmp": PIXELS_PER_BYTE,
    "openexr": PIXELS_PER_BYTE, "tiff none": 8, "tiff packbits": 8 * 64, "tiff lzw": 8 * 2560,
    "tiff zip": PIXELS_PER_BYTE, "tiff jpeg": PIXELS_PER_BYTE,
    "webp": 65536,  # three times what a plain lossless one reaches
}  # fmt: skip
"""Pixels that a byte can hold at most; a plain picture of other kinds may take next to nothing."""


@contextmanager
def opened(
    path: Path, kinds: tuple[str, ...], thorough: bool = False
) -> Iterator[OpenImageIO.ImageInput]:
    """Open a picture for decoding; its header has been read.

    Args:
        path: of the file, whose name need not tell its kind.
        kinds: which it may be, see ``IN_SCENES``.
        thorough: whether a PNG's checksums are compared.

    Raises:
        DataError: the file is missing, cut short, of another kind, or too large to be decoded.
    """
    try:
        if not path.is_file():
            raise DataError(f"image {path} does not exist or is not a file")
        with path.open("rb") as file:
            kind = _require_kind(path, file, kinds)
            fault = _png_fault(file, thorough) if kind == "png" else None
            if fault:
                raise DataError(unreadable(path, fault))
            source = _open(path, file, kind)
            try:
                _require_bearable(path, source.spec(), kind, os.fstat(file.fileno()).st_size)
                yield source
            finally:
                source.close()
    except (OSError, ValueError) as error:  # a ValueError: a null byte in the name
        reason = getattr(error, "strerror", None) or error
        raise DataError(f"image {path} cannot be read: {reason}") from error


def unreadable(path: Path, message: str) -> str:
    """Return the sentence that says why a picture cannot be used."""
    reason = " ".join(message.split()) or "not a picture"
    return f"image {path} is damaged or not a picture ({reason}); restore the file"


def _require_kind(path: Path, file: BinaryIO, kinds: tuple[str, ...]) -> str:
    """Return what the file's first bytes say that it is."""
    start = file.read(12)
    kind = next((kind for sign, kind in _SIGNATURES.items() if start.startswith(sign)), None)
    if kind == "webp" and start[8:] != b"WEBP":
        kind = None
    if kind is None or kind not in kinds:
        found = "empty" if not start else f"of the kind '{kind}'" if kind else "of no known kind"
        allowed = ", ".join(kinds).upper()
        raise DataError(unreadable(path, f"its content is {found}; allowed: {allowed}"))
    return kind


def _open(path: Path, file: BinaryIO, kind: str) -> OpenImageIO.ImageInput:
    # Without this hint OpenImageIO premultiplies by alpha, in 8 bits.
    config = OpenImageIO.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = OpenImageIO.ImageInput.open(_name(path, file, kind), config)
    if source is None:
        raise DataError(unreadable(path, OpenImageIO.geterror()))
    if source.format_name() != kind:
        source.close()
        raise DataError(unreadable(path, f"it opens as '{source.format_name()}', not as '{kind}'"))
    return source


def _name(path: Path, file: BinaryIO, kind: str) -> str:
    """Return a name by which OpenImageIO opens the file as what it is.

    It goes by the name first, and takes none that is not UTF-8; so a name that says something else
    is left out, where the system has another for open files.
    """
    text = str(path)
    plain = path.suffix.lower() in _SUFFIXES[kind] and text.isprintable()
    if plain or os.name != "posix":
        return text
    file.seek(0)  # some systems let it begin where we are
    return f"/dev/fd/{file.fileno()}"


def _require_bearable(path: Path, spec: OpenImageIO.ImageSpec, kind: str, size: int) -> None:
    """Raise DataError if the decoded picture would be huge, or has more than RGBA."""
    width, height = spec.width, spec.height
    if max(width, height) > MOST_SIDE or width * height * spec.depth > MOST_PIXELS:
        raise DataError(
            f"image {path} is {width} x {height} px; allowed: up to {MOST_SIDE} px a side and "
            f"{MOST_PIXELS // 1_000_000} million pixels; shrink it"
        )
    if spec.nchannels > 4:
        raise DataError(f"image {path} has {spec.nchannels} channels; allowed: grey, RGB and RGBA")
    packed = f"tiff {spec.get('compression', '')}" if kind == "tiff" else kind
    if width * height > _MOST_PER_BYTE.get(packed, MOST_PIXELS) * size:
        raise DataError(unreadable(path, f"{size} bytes cannot hold {width} x {height} px"))


def _png_fault(file: BinaryIO, thorough: bool) -> str | None:
    """Return what is wrong with a PNG's chunks: their order, or, if thorough, a wrong checksum.

    The decoder would notice too, but only with the pixels, and libpng then prints to stderr.
    """
    size, found = os.fstat(file.fileno()).st_size, list[bytes]()
    file.seek(8)
    while len(header := file.read(8)) == 8:
        length, kind = struct.unpack(">I4s", header)
        if (kind == b"IHDR") != (not found) or (kind == b"IHDR" and length != 13):
            return "the PNG does not begin with one header"
        if kind == b"IEND":
            return None if b"IDAT" in found else "the PNG has no pixels"
        found.append(kind)
        end = file.tell() + length + 4
        if end > size:
            break
        if thorough and zlib.crc32(kind + file.read(length)) != int.from_bytes(file.read(4), "big"):
            return "a checksum in the PNG is wrong"
        file.seek(end)
    return "the PNG ends too early"
