"""Values as whole numbers of a step, in few bytes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.runs import packed_values

Array = NDArray[Any]

_MOST = 2**30
"""Largest number of steps; differences of two then have 32 bits."""


def rounded(values: Array, step: float) -> Array:
    """Return how many steps each value is, int64.

    Raises:
        ValueError: one is not finite.
    """
    if not np.isfinite(values).all():
        raise ValueError("a value is not finite")
    levels = np.rint(values.astype(np.float64) / step).clip(-_MOST, _MOST)
    whole: Array = levels.astype(np.int64)
    return whole


def values(levels: Array, step: float) -> Array:
    """Return so many steps, float32."""
    found: Array = (levels * float(step)).astype(np.float32)
    return found


def encode(levels: Array) -> tuple[Tensor, dict[str, Any]]:
    """Return the bytes (B,) uint8 of whole numbers (N, C), and what tells how to read them.

    They are folded to 0, -1, 1, -2, 2, ... as 0, 1, 2, 3, 4, ..., so that of small ones the upper
    bytes are 0, and stand column by column, all lowest bytes before all that are next.
    """
    folded = ((levels << 1) ^ (levels >> 63)).astype("<u4")
    columns = np.ascontiguousarray(folded.T)
    planes = columns.view(np.uint8).reshape(*columns.shape, 4)
    return packed_values.encode(np.ascontiguousarray(np.moveaxis(planes, 2, 0)), packed_values.RAW)


def decode(data: Tensor, about: Mapping[str, Any]) -> Array:
    """Return the whole numbers (N, C), int64, that ``encode`` was given.

    Raises:
        ValueError, LookupError, TypeError: they are not what ``about`` says.
    """
    planes = packed_values.decode(data, about)
    if planes.dtype != np.uint8 or planes.ndim != 3 or len(planes) != 4:
        raise ValueError(f"packed steps have shape {planes.shape} of {planes.dtype}")
    columns = np.ascontiguousarray(np.moveaxis(planes, 0, 2)).view("<u4")[..., 0]
    folded = columns.T.astype(np.int64)
    return (folded >> 1) ^ -(folded & 1)
