"""How the values of a packed tensor are written: as whole steps, halves or codes, compressed.

Whole numbers of steps are stored as differences along that axis which leaves the fewest bytes, or
as they are. What neighbours share, in a grid or among splats in Morton order, is then stored once.
"""

from __future__ import annotations

import lzma
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[Any]

KINDS = "steps", "half", "codes", "raw"

MOST_HALF = 65504.0
"""The largest value of the kind "half"."""

_MOST_BITS = 16
"""Of a value that is rounded to steps."""

_ENDS = 8
"""Bytes of the least value and the step, float32 each."""

_FILTERS = [
    {
        "id": lzma.FILTER_LZMA2,
        "preset": 9 | lzma.PRESET_EXTREME,
        "dict_size": 1 << 22,
        "lc": 0,  # neighbouring bytes are differences, and say little of one another
        "lp": 0,
        "pb": 0,
    }
]
_MEMORY = 1 << 25
"""Most that decompression may take: the dictionary and a little [bytes]."""


class Form(NamedTuple):
    """How the values of a tensor are written.

    Attributes:
        kind: one of ``KINDS``: whole numbers of steps between the least and the largest value, 16
            bits each, codes (N, stages) uint8, or as they are, of any type.
        bits: of each value that is rounded to steps, 1 to 16.
    """

    kind: str
    bits: int = 0


HALF, CODES, RAW = Form("half"), Form("codes"), Form("raw")


def rounded(values: Array, form: Form) -> Array:
    """Return values (...) float32 as a form leaves them; halves are finite."""
    if form.kind == "steps":
        return _from_steps(*_to_steps(values, form.bits))
    return values if form.kind == "raw" else values.astype("<f2").astype(np.float32)


def encode(values: Array, form: Form) -> tuple[Tensor, dict[str, Any]]:
    """Return a tensor's bytes (B,) uint8, and what tells how to read them, plain JSON.

    Args:
        values: of the tensor, all finite, and at most ``MOST_HALF`` in size where they are halves.
        form: how they are written.
    """
    about = {"kind": form.kind, "shape": list(values.shape), "type": str(values.dtype)}
    if form.kind != "steps":
        return _as_tensor(_compressed(_PLAIN[form.kind](values))), about
    levels, ends = _to_steps(values, form.bits)
    found: list[tuple[int, int | None, bytes]] = []
    for axis in (None, *(axis for axis, size in enumerate(values.shape) if size > 1)):
        data = _compressed(_column_bytes(levels if axis is None else _differences(levels, axis)))
        found.append((len(data), axis, data))
    _, along, data = min(found, key=lambda each: each[0])
    return _as_tensor(ends.tobytes() + data), about | {"along": along, "bits": form.bits}


def decode(data: Tensor, about: Mapping[str, Any]) -> Array:
    """Return the values of a packed tensor; of codes, the codes.

    Raises:
        ValueError, LookupError, TypeError: they are not what ``about`` says.
    """
    kind, shape, dtype = about["kind"], tuple(map(int, about["shape"])), np.dtype(about["type"])
    if kind not in KINDS or min(shape, default=0) < 0:
        raise ValueError(f"nothing is packed as '{kind}' of shape {shape}")
    count, stored = math.prod(shape), data.numpy().tobytes()
    if kind == "raw":
        return np.frombuffer(_whole(stored, count * dtype.itemsize), dtype).reshape(shape).copy()
    if kind == "codes":
        codes = np.frombuffer(_whole(stored, count), np.uint8)
        return codes.reshape(shape[::-1]).T.copy()
    if kind == "half":
        halves = _from_columns(_whole(stored, 2 * count), shape, np.dtype("<f2"))
        return halves.astype(np.float32)
    width = _dtype_of(int(about["bits"]))
    levels = _from_columns(_whole(stored[_ENDS:], count * width.itemsize), shape, width)
    if about["along"] is not None:
        levels = _sums(levels, int(about["along"]))
    return _from_steps(levels, np.frombuffer(stored[:_ENDS], "<f4"))


def _to_steps(values: Array, bits: int) -> tuple[Array, Array]:
    """Return whole numbers from 0 to 2^bits - 1, and the least value and the step (2,)."""
    most = 2**bits - 1
    low, high = (values.min(), values.max()) if values.size else (0.0, 0.0)
    ends = np.array([low, (np.float64(high) - low) / most], "<f4")
    places = (values.astype(np.float64) - ends[0]) / (ends[1] if ends[1] > 0 else 1.0)
    return places.round().clip(0, most).astype(_dtype_of(bits)), ends


def _from_steps(levels: Array, ends: Array) -> Array:
    low, step = ends
    values: Array = (low + step * levels.astype(np.float32)).astype(np.float32)
    return values


def _dtype_of(bits: int) -> np.dtype[Any]:
    if not 1 <= bits <= _MOST_BITS:
        raise ValueError(f"{bits} bits a value")
    return np.dtype("<u1" if bits <= 8 else "<u2")


def _differences(levels: Array, axis: int) -> Array:
    """Return what each number adds to the one before, in as many bits, small ones first.

    That is 0, -1, 1, -2, 2, ..., so that the upper of two bytes is 0 for most.
    """
    before = np.roll(levels, 1, axis)
    np.moveaxis(before, axis, 0)[0] = 0
    signed = (levels - before).view(levels.dtype.str.replace("u", "i"))
    return ((signed << 1) ^ (signed >> (8 * signed.itemsize - 1))).view(levels.dtype)


def _sums(folded: Array, axis: int) -> Array:
    """Return the numbers whose ``_differences`` along the axis are given."""
    one = folded.dtype.type(1)
    signs = np.where(folded & one, ~folded.dtype.type(0), folded.dtype.type(0))
    return np.cumsum((folded >> one) ^ signs, axis=axis, dtype=folded.dtype)


def _column_bytes(values: Array) -> bytes:
    """Return values column by column, all lower bytes before all higher ones.

    The last axis are the columns, where there are two axes or more.
    """
    columns = np.ascontiguousarray(values.reshape(-1, _width(values.shape)).T)
    data: bytes = columns.view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
    return data


def _from_columns(data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Array:
    """Return what ``_column_bytes`` was given."""
    parts = np.frombuffer(data, np.uint8).reshape(dtype.itemsize, -1)
    columns = np.frombuffer(parts.T.tobytes(), dtype).reshape(_width(shape), -1)
    return np.ascontiguousarray(columns.T).reshape(shape)


_PLAIN: dict[str, Callable[[Array], bytes]] = {
    "half": lambda values: _column_bytes(values.astype("<f2")),
    "codes": lambda values: values.T.tobytes(),
    "raw": lambda values: values.tobytes(),
}


def _width(shape: tuple[int, ...]) -> int:
    return (shape[-1] if len(shape) > 1 else 1) or 1


def _compressed(data: bytes) -> bytes:
    return lzma.compress(data, lzma.FORMAT_XZ, lzma.CHECK_CRC32, filters=_FILTERS)


def _whole(data: bytes, length: int) -> bytes:
    """Return the bytes that were compressed; raise ValueError unless they are so many."""
    reader = lzma.LZMADecompressor(lzma.FORMAT_XZ, _MEMORY)
    try:
        found = reader.decompress(data, length + 1)
    except lzma.LZMAError as error:
        raise ValueError(f"packed data is damaged: {error}") from error
    if len(found) != length or not reader.eof:
        raise ValueError(f"packed data has not the {length} bytes that it should have")
    return found


def _as_tensor(data: bytes) -> Tensor:
    return torch.frombuffer(bytearray(data), dtype=torch.uint8)
