"""The file itself: a magic text, a version, a header of JSON, and parts."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from typing import Any

from gsdmsr_cli.moving.parts import Part, part_of

SUFFIX = ".dsplat"
MAGIC = b"dsplat\r\n"
VERSION = 1
_FIXED = struct.Struct("<8sII")

WRONG = KeyError, TypeError, ValueError, AttributeError, OverflowError
"""What reading raises where a file is not what it should be."""


def to_bytes(header: Mapping[str, Any], parts: Sequence[Part]) -> bytes:
    """Return the file of a header, to which the list of parts is added."""
    whole = dict(header) | {"parts": [part.described() for part in parts]}
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    return b"".join([_FIXED.pack(MAGIC, VERSION, len(text)), text, *(p.stream for p in parts)])


def from_bytes(data: bytes) -> tuple[dict[str, Any], dict[str, Part]]:
    """Return the header of a file, and its parts by name.

    Raises:
        ValueError: it is another file, of a newer version, cut short or damaged; the text is a
            phrase that follows on the file's name.
    """
    if len(data) < _FIXED.size or not data.startswith(MAGIC):
        raise ValueError("is not a .dsplat file")
    _, version, length = _FIXED.unpack_from(data)
    if version != VERSION:
        raise ValueError(f"is a .dsplat file of version {version}; this program reads {VERSION}")
    end = _FIXED.size + length
    if len(data) < end:
        raise ValueError("is cut short: its header is not whole")
    try:
        header = json.loads(data[_FIXED.size : end])
        parts: dict[str, Part] = {}
        for described in header["parts"]:
            start, end = end, end + int(described["bytes"])
            if not start <= end <= len(data):
                raise ValueError("is cut short: some of its parts are missing")
            part = part_of(described, data[start:end])
            parts[part.name] = part
    except RecursionError as error:
        raise ValueError("has a damaged header") from error
    except WRONG as error:
        known = isinstance(error, ValueError) and str(error).startswith("is cut short")
        raise error if known else ValueError(f"has a damaged header: {error}") from error
    return header, parts
