"""Reads and writes the vertices of a PLY file (Turk 1994) as a table."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


def read_vertices(path: Path) -> NDArray[np.void]:
    """Return the vertices, one row each, with a field for every property.

    They must be the file's first element and may only have properties of fixed size.

    Raises:
        DataError: the file cannot be read, is cut short or is not such a PLY file.
    """
    try:
        with path.open("rb") as file:
            encoding, dtype, count = _read_header(path, file)
            payload = file.read()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error
    if encoding == "ascii":
        return _parsed(path, payload, dtype, count)
    if len(payload) < count * dtype.itemsize:
        raise DataError(
            f"{path} is cut short: {len(payload)} bytes of vertices where its header announces "
            f"{count} times {dtype.itemsize}; copy or export it again"
        )
    return np.frombuffer(payload[: count * dtype.itemsize], dtype)


def _read_header(path: Path, file: BinaryIO) -> tuple[str, np.dtype[np.void], int]:
    """Read up to ``end_header``; return the encoding, the row's type and the number of rows."""
    if file.readline(16).strip() != b"ply":
        raise DataError(f"{path} is not a PLY file; its first line is not 'ply'")
    encoding, count = "", None
    element, fields = "", list[tuple[str, str]]()
    while (line := file.readline(1024)) and line.strip() != b"end_header":
        match line.decode("ascii", "replace").split():
            case ["format", name, "1.0"] if name in _ORDERS:
                encoding = name
            case ["element", "vertex", number] if element == "" and number.isdecimal():
                element, count = "vertex", int(number)
            case ["element", name, _]:
                element = name
            case ["property", kind, name] if element == "vertex" and kind in _TYPES:
                fields.append((name, _TYPES[kind]))
            case ["property", *_] if element == "vertex":
                raise DataError(f"{path}: a vertex property has no fixed size: {line!r}")
    if not (line and encoding and count is not None and fields):
        raise DataError(f"{path} is not a PLY file that starts with vertices")
    if len(dict(fields)) != len(fields):
        raise DataError(f"{path} names a vertex property twice")
    order = _ORDERS[encoding]
    return encoding, np.dtype([(name, order + kind) for name, kind in fields]), count


def _parsed(path: Path, text: bytes, dtype: np.dtype[np.void], count: int) -> NDArray[np.void]:
    """Return the vertices that are written out as decimal numbers."""
    names = dtype.names or ()
    if len(text) + 1 < 2 * count * len(names):  # a digit and a space for each
        raise _damaged(path, count, len(names))
    words = text.split(maxsplit=count * len(names))[: count * len(names)]
    try:
        numbers = np.array(words, dtype=np.float64).reshape(count, len(names))
    except ValueError as error:
        raise _damaged(path, count, len(names)) from error
    rows = np.empty(count, dtype)
    for name, column in zip(names, numbers.T, strict=True):
        rows[name] = _fitting(path, name, column, dtype[name])
    return rows


def _fitting(
    path: Path, name: str, column: NDArray[np.float64], kind: np.dtype[Any]
) -> NDArray[np.float64]:
    """Return the column if all of its numbers are of the property's type, else raise DataError."""
    if kind.kind == "f":
        return column
    range_ = np.iinfo(kind)
    wrong = ~((column >= range_.min) & (column <= range_.max))  # NaN is in no range
    if wrong.any():
        raise DataError(
            f"{path}: vertex {wrong.argmax()} has {column[wrong][0]:g} as its {name}; allowed: "
            f"{range_.min} to {range_.max}"
        )
    return column


def _damaged(path: Path, count: int, columns: int) -> DataError:
    return DataError(
        f"{path} is damaged or cut short: it does not hold {count} times {columns} numbers"
    )
