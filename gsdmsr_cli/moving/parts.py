"""Tables of whole numbers as zlib streams: the parts of a ``.dsplat`` file."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Floats = NDArray[np.float64]

MOST_BYTES = 6
"""Of an integer: a browser's numbers hold 53 bits exactly."""

MOST_INFLATED, MOST_HELD = 1100, 1 << 30
"""No zlib stream holds more than so many times its bytes; and no part more than so many bytes."""

LEVEL = 9
"""Of zlib: the file is written once and fetched often."""

QUICKLY = 4
"""A level for parts of which only is asked how long they are, about."""


@dataclass(frozen=True, eq=False)
class Table:
    """A table of integers q, each of which stands for ``least`` + ``step`` * q: a part to be.

    Attributes:
        name: of the part.
        integers: (rows, columns), 0 or more unless ``signed``.
        least, step: one number a column, or one for all.
        signed: whether integers may be below 0.
        either: whether differences to the row before are packed in their place if that is shorter.
        extra: what else the header says of it.
    """

    name: str
    integers: Integers
    least: tuple[float, ...]
    step: tuple[float, ...]
    signed: bool = False
    either: bool = False
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> int:
        """How many there are."""
        return len(self.integers)

    @property
    def columns(self) -> int:
        """How many there are."""
        return int(self.integers.shape[1])


@dataclass(frozen=True)
class Part:
    """A table as a file holds it.

    Attributes:
        name: of the part.
        rows, columns: of the table.
        width: bytes of an integer, 1 to 6.
        signed: whether integers have their sign in the lowest bit.
        difference: whether an integer is the difference to the row before, with its sign.
        least, step: one number a column, or one for all.
        extra: what else the header says of it.
        stream: the integers, column by column, each as planes from the lowest byte on; deflated.
    """

    name: str
    rows: int
    columns: int
    width: int
    signed: bool
    difference: bool
    least: tuple[float, ...]
    step: tuple[float, ...]
    extra: Mapping[str, Any]
    stream: bytes

    def described(self) -> dict[str, Any]:
        """Return what the header of the file says of the part."""
        flags = {"signed": self.signed, "difference": self.difference}
        return {
            "name": self.name,
            "rows": self.rows,
            "columns": self.columns,
            "width": self.width,
            **{flag: True for flag, given in flags.items() if given},
            "least": list(self.least),
            "step": list(self.step),
            **self.extra,
            "bytes": len(self.stream),
        }


def part_of(described: Mapping[str, Any], stream: bytes) -> Part:
    """Return the part that a header describes.

    Raises:
        ValueError, KeyError, TypeError: the description is not one.
    """
    rows, columns, width = (int(described[name]) for name in ("rows", "columns", "width"))
    least, step = (tuple(map(float, described[name])) for name in ("least", "step"))
    sizes = {1, columns}
    fits = rows >= 0 and columns >= 1 and 1 <= width <= MOST_BYTES
    if not fits or len(least) not in sizes | {3} or len(step) not in sizes | {3}:
        raise ValueError(f"part '{described['name']}' is described in a way that does not fit")
    known = {"name", "rows", "columns", "width", "signed", "difference", "least", "step", "bytes"}
    flags = bool(described.get("signed")), bool(described.get("difference"))
    extra = {name: value for name, value in described.items() if name not in known}
    name = str(described["name"])
    return Part(name, rows, columns, width, *flags, least, step, extra, stream)


def short(values: Floats) -> Floats:
    """Return numbers that take few characters in a header, near to the given ones."""
    return np.array([float(f"{value:.6g}") for value in values.tolist()])


def quantised(values: Floats, least: Floats, step: Floats) -> Integers:
    """Return the integers q, 0 or more, whose least + step * q is nearest to values."""
    return np.rint((values - least) / step).astype(np.int64).clip(min=0)


def plain_table(name: str, values: Floats, step: float | Floats) -> Table:
    """Return values (rows, columns) counted from the least of each column on.

    Args:
        name: of the part.
        values: finite.
        step: above 0, one for all columns or one of each.
    """
    steps = short(np.atleast_1d(np.asarray(step, np.float64)))
    least = short(values.min(axis=0) if len(values) else np.zeros(values.shape[1]))
    q = quantised(values, least, steps)
    return Table(name, q, tuple(least.tolist()), tuple(steps.tolist()), either=True)


def signed_table(name: str, q: Integers, step: float) -> Table:
    """Return integers (rows, columns) about 0, which stand for as many times ``step``.

    ``step`` is one of ``short`` numbers.
    """
    return Table(name, q, (0.0,), (step,), signed=True)


def packed(table: Table, level: int = LEVEL) -> Part:
    """Return a table as a part, at a level of zlib.

    Raises:
        ValueError: it needs integers of too many bytes.
    """
    way = _deflated(table, False, level)
    if not table.either:
        return way
    return min(way, _deflated(table, True, level), key=lambda part: len(part.stream))


def _deflated(table: Table, difference: bool, level: int) -> Part:
    q = np.diff(table.integers, axis=0, prepend=0) if difference else table.integers
    if table.signed or difference:
        q = np.where(q < 0, -2 * q - 1, 2 * q)
    rows, columns = q.shape
    width = max(1, -(-int(q.max(initial=0)).bit_length() // 8))
    if width > MOST_BYTES:
        raise ValueError(f"'{table.name}' needs integers of {width} bytes")
    planes = np.ascontiguousarray(q.T).astype("<u8").view(np.uint8).reshape(columns, rows, 8)
    stream = zlib.compress(planes[:, :, :width].transpose(0, 2, 1).tobytes(), level)
    flags, limits = (table.signed, difference), (table.least, table.step)
    return Part(table.name, rows, columns, width, *flags, *limits, table.extra, stream)


def integers_of(part: Part | Table) -> Integers:
    """Return what a part's integers say, (rows, columns): signs and differences are undone.

    Raises:
        ValueError: the stream is damaged, or not of this length.
    """
    if isinstance(part, Table):
        return part.integers
    u = _inflated(part)
    if part.signed or part.difference:
        u = (u >> 1) ^ -(u & 1)
    return np.cumsum(u, axis=0) if part.difference else u


def _inflated(part: Part) -> Integers:
    wanted = part.rows * part.columns * part.width
    if wanted > MOST_INFLATED * (len(part.stream) + 1) or wanted > MOST_HELD:
        raise ValueError(f"part '{part.name}' cannot hold {wanted} bytes")
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(part.stream, wanted + 1)  # a bomb is not inflated
    except zlib.error as error:
        raise ValueError(f"part '{part.name}' is damaged: {error}") from error
    if len(data) != wanted or not inflater.eof or inflater.unused_data:
        raise ValueError(f"part '{part.name}' does not hold {wanted} bytes")
    planes = np.frombuffer(data, np.uint8).reshape(part.columns, part.width, part.rows)
    u = np.zeros((part.rows, part.columns), np.int64)
    for place in range(part.width):
        u |= planes[:, place].T.astype(np.int64) << (8 * place)
    return u


def values_of(part: Part | Table) -> Floats:
    """Return the values (rows, columns) of a part.

    Raises:
        ValueError: see ``integers_of``.
    """
    return np.asarray(part.least) + np.asarray(part.step) * integers_of(part)
