"""Reads arrays of NumPy's files, .npy and .npz, no larger than the files can hold."""

from __future__ import annotations

import math
from pathlib import Path
from typing import BinaryIO
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError

MOST_BYTES = 1 << 30
"""Of an array in an .npz file, which may be compressed to almost nothing."""


def read_npy(path: Path) -> NDArray[np.float64]:
    """Return the array of numbers in an .npy file.

    Raises:
        DataError: the file cannot be read, is cut short or holds something else.
    """
    try:
        with path.open("rb") as file:
            return _read(file, path.stat().st_size)
    except Exception as error:  # NumPy's parser of headers raises whatever the bytes provoke
        raise _damaged(path, "holds no numbers", error) from error


def read_npz(path: Path, name: str) -> NDArray[np.float64]:
    """Return the array of numbers with a name in an .npz file.

    Raises:
        DataError: the file cannot be read, is cut short, or has no such array of numbers.
    """
    try:
        with ZipFile(path) as archive:
            entry = archive.getinfo(f"{name}.npy")
            if entry.compress_type not in (ZIP_STORED, ZIP_DEFLATED) or entry.flag_bits & 1:
                raise ValueError("it is packed in a way that NumPy does not write")
            if entry.file_size > MOST_BYTES:
                raise ValueError(f"it unpacks to more than {MOST_BYTES >> 20} MiB")
            with archive.open(entry) as file:
                return _read(file, entry.file_size)  # type: ignore[arg-type]
    except Exception as error:  # as above; zlib and zipfile have errors of their own
        raise _damaged(path, f"has no {name!r} of numbers", error) from error


def _read(file: BinaryIO, size: int) -> NDArray[np.float64]:
    """Return the array in a file of so many bytes."""
    version = npy.read_magic(file)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, columns_first, dtype = read_header(file)
    if dtype.kind not in "fiu":
        raise ValueError(f"its entries are of the type {dtype}")
    needed = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or needed > size:
        raise ValueError(f"its header announces {shape} entries, which {size} bytes cannot hold")
    content = file.read(needed)
    if len(content) < needed:
        raise ValueError("it is cut short")
    array = np.frombuffer(content, dtype).reshape(shape, order="F" if columns_first else "C")
    return array.astype(np.float64)


def _damaged(path: Path, what: str, error: Exception) -> DataError:
    reason = str(error).partition("\n")[0][:200] or type(error).__name__
    return DataError(f"{path}: is damaged or {what}: {reason}; restore the file")
