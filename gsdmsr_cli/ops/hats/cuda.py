"""Shares of nodes on a GPU, see hats.cu."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

from torch import Tensor

from gsdmsr_cli.backends.cuda import recording
from gsdmsr_cli.backends.cuda.compiler import MOST_VIEWS
from gsdmsr_cli.backends.cuda.launch import blocks, launch

_THREADS = 128


class _Times(ctypes.Structure):
    _fields_ = (("count", ctypes.c_int), ("time", ctypes.c_float * MOST_VIEWS))


def hats(times: Sequence[float], values: Tensor) -> Tensor:
    """Return what ``ops.hats.hats`` does.

    Raises:
        ValueError: there are more than ``MOST_VIEWS`` times.
    """
    if len(times) > MOST_VIEWS:
        raise ValueError(f"{len(times)} times; at most {MOST_VIEWS} are asked for at once")
    found = values.new_empty(len(times), len(values))
    packed = recording.vary(_Times(len(times), (ctypes.c_float * MOST_VIEWS)(*times)), _fill)
    grid = blocks(found.numel(), _THREADS), 1
    launch("hats", "hats", grid, _THREADS, packed, len(values), found, on=values.device)
    return found


def _fill(packed: _Times, inputs: Any) -> None:
    packed.time[: packed.count] = inputs.times
