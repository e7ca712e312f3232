"""What work says of itself while it is recorded, so that it can be replayed with other inputs.

A recording replays the same launches with the same arguments, on the same memory. So whoever hands
a kernel something that is another one next time, such as a camera, tells how to make it anew, and
whoever reads memory of its own sees to it that it stays. Where nothing is recorded nobody listens.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

S = TypeVar("S", bound=ctypes.Structure)

Fill = Callable[[Any, Any], None]
"""Writes what belongs to other inputs into a structure: (structure, inputs)."""


class Launched(NamedTuple):
    """A launch, see ``Driver.launch``; ``values`` are what the addresses are of."""

    source: str
    kernel: str
    grid: tuple[int, int]
    block: int
    arguments: ctypes.Array[ctypes.c_void_p]
    device: torch.device
    values: list[Any]


class Followed(Protocol):
    """Something that a replay depends on, or that it changes, outside of the recording."""

    def is_good(self) -> bool:
        """Return whether the recording may be replayed once more."""

    def replayed(self) -> None:
        """Take note of a replay that is on its way."""


class Recorder(Protocol):
    """Who listens while work is recorded."""

    def listens(self) -> bool:
        """Return whether what this thread does now is part of the work, and not beside it."""

    def vary(self, structure: ctypes.Structure, fill: Fill) -> None:
        """See ``vary``."""

    def keep(self, tensor: Tensor) -> None:
        """See ``keep``."""

    def follow(self, what: Followed) -> None:
        """See ``follow``."""

    def launched(self, launched: Launched) -> None:
        """Take note of a launch."""


_recorder: Recorder | None = None
# no context variable: autograd goes backward on another thread, to which these are unknown


@contextmanager
def recorded_by(recorder: Recorder) -> Iterator[None]:
    """Let a recorder listen until the block ends, on whatever thread the work goes on."""
    global _recorder
    before, _recorder = _recorder, recorder
    try:
        yield
    finally:
        _recorder = before


def _listening() -> Recorder | None:
    recorder = _recorder
    return recorder if recorder is not None and recorder.listens() else None


def is_recording() -> bool:
    """Return whether anybody listens."""
    return _listening() is not None


def vary(structure: S, fill: Fill) -> S:
    """Return a structure of arguments, which ``fill`` can make anew from other inputs.

    To be called before it is given to a kernel. The structure stays the same object.
    """
    if (recorder := _listening()) is not None:
        recorder.vary(structure, fill)
    return structure


def keep(tensor: Tensor) -> Tensor:
    """Return a tensor that is read, and belongs neither to the model nor to the work itself."""
    if (recorder := _listening()) is not None:
        recorder.keep(tensor)
    return tensor


def follow(what: Followed) -> None:
    """Let something be asked before, and told after every replay."""
    if (recorder := _listening()) is not None:
        recorder.follow(what)


def tell(launched: Callable[[], Launched]) -> None:
    """Tell of a launch, if anybody listens."""
    if (recorder := _listening()) is not None:
        recorder.launched(launched())
