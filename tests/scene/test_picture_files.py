"""Picture files are known by their content, and refused before they take the machine's memory."""

from __future__ import annotations

import os
import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from datasets import noise, write_picture

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.picture_files import IN_SCENES


def png(width: int, height: int, depth: int = 8, colour: int = 0, data: bytes = b"") -> bytes:
    """A PNG with a header of its own and whatever pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + checksum

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(data, 9)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def refused(path: Path, message: str, kinds: tuple[str, ...] = IN_SCENES) -> None:
    for read in (imaging.read_image, imaging.image_size):
        with pytest.raises(DataError, match=message) as error:
            read(path, kinds)
        assert str(path) in str(error.value) and str(error.value).isprintable()


@pytest.mark.parametrize("size", [(20000, 20000), (16385, 1), (16384, 16384), (1, 100000)])
def test_a_huge_picture_is_refused_by_its_header(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    path = tmp_path / "bomb.png"
    path.write_bytes(png(width, height, 1, data=bytes((width // 8 + 1) * height)))
    refused(path, rf"{width} x {height} px; allowed: up to 16384 px a side and 256 million pixels")


def test_a_picture_as_large_as_cameras_take_is_accepted(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(16384, 12288, 1, data=bytes((16384 // 8 + 1) * 12288)))
    assert imaging.image_size(path) == (16384, 12288)


def test_a_header_that_promises_more_than_the_file_can_hold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(15000, 15000, 8, 6, data=b"few"))
    refused(path, r"bytes cannot hold 15000 x 15000 px")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize(
    "name", ["a.jpg", "a.png", "a.exr", "a.tga", "a.null", "a", "a?b=1.png", "a\n\x1b[31m.png"]
)
def test_the_content_decides_not_the_name(tmp_path: Path, suffix: str, name: str) -> None:
    pixels = np.full((8, 16, 3), (200, 100, 50), np.uint8)
    write_picture(tmp_path / f"plain{suffix}", pixels)
    path = (tmp_path / f"plain{suffix}").rename(tmp_path / name)
    assert imaging.image_size(path) == (16, 8)
    assert np.abs(imaging.read_image(path).astype(int) - pixels).max() <= 3


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes on Linux only")
def test_a_name_that_is_not_utf8_is_read(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", noise(4, 6, 3))
    path = (tmp_path / "a.png").rename(tmp_path / os.fsdecode(b"\xff\xfe.png"))
    np.testing.assert_array_equal(imaging.read_image(path), noise(4, 6, 3))


@pytest.mark.parametrize("suffix", [".bmp", ".tiff", ".webp", ".ppm", ".hdr", ".exr"])
@pytest.mark.parametrize("name", ["a.png", None])
def test_other_kinds_are_refused_in_scenes(tmp_path: Path, suffix: str, name: str | None) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".exr":
        imaging.write_exr(path, np.zeros((4, 5, 3), np.float32), ("R", "G", "B"))
    else:
        dtype = np.float32 if suffix == ".hdr" else np.uint8
        assert cv2.imwrite(str(path), np.ones((4, 5, 3), dtype))
    refused(path.rename(tmp_path / (name or path.name)), "its content is .*; allowed: PNG, JPEG")


def test_what_only_a_name_makes_a_picture_is_none(tmp_path: Path) -> None:
    """OpenImageIO makes pictures up for some names."""
    path = tmp_path / "a.null"
    path.write_bytes(b"anything")
    refused(path, "no known kind")


@pytest.mark.parametrize(("compression", "fits"), [(1, 40), (5, 150), (8, 150), (32773, 100)])
def test_a_tiff_that_promises_more_than_it_can_hold_is_refused(
    tmp_path: Path, compression: int, fits: int
) -> None:
    path, settings = tmp_path / "a.tiff", (cv2.IMWRITE_TIFF_COMPRESSION, compression)
    assert cv2.imwrite(str(path), np.zeros((fits, fits, 3), np.uint8), settings)
    assert imaging.image_size(path, ("tiff",)) == (fits, fits)
    sized = path.read_bytes()
    for tag in (256, 257):  # width and height
        for kind in (3, 4):  # of two bytes or of four
            entry = struct.pack("<HHII", tag, kind, 1, fits)
            sized = sized.replace(entry, struct.pack("<HHII", tag, kind, 1, 16000))
    path.write_bytes(sized)
    refused(path, "bytes cannot hold 16000 x 16000 px", ("tiff",))


def test_a_webp_that_promises_more_than_it_can_hold_is_refused(tmp_path: Path) -> None:
    lossless = (cv2.IMWRITE_WEBP_QUALITY, 101)
    content = bytearray(cv2.imencode(".webp", noise(8, 10, 3), lossless)[1].tobytes())
    at = content.index(b"VP8L") + 9
    head = int.from_bytes(content[at : at + 4], "little") >> 28 << 28
    content[at : at + 4] = (head | 9404 << 14 | 12079).to_bytes(4, "little")
    (tmp_path / "a.webp").write_bytes(content)
    refused(tmp_path / "a.webp", "bytes cannot hold 12080 x 9405 px", ("webp",))


def test_a_plain_webp_is_read(tmp_path: Path) -> None:
    lossless = (cv2.IMWRITE_WEBP_QUALITY, 101)
    assert cv2.imwrite(str(tmp_path / "a.webp"), np.zeros((3000, 4000, 3), np.uint8), lossless)
    assert imaging.image_size(tmp_path / "a.webp", ("webp",)) == (4000, 3000)
