"""How much room to give to a list whose length only the GPU knows, without waiting for it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import recording

MARGIN = 1.5
"""Room in units of the longest of the last lists."""

WINDOW = 256
"""How many lists that is: so many steps, within which most views of a training have their turn."""

LEAST = 1 << 14


class _News(NamedTuple):
    """A length on its way from the GPU.

    Attributes:
        length: where it arrives.
        arrived: tells when; None if it is there.
        rows: what the list was made from.
        room: what it was given.
    """

    length: Tensor
    arrived: torch.cuda.Event | None
    rows: int
    room: int


class Room:
    """Guesses lengths from those of earlier lists, which are read when they have arrived.

    Guesses follow the number of rows, so that growing makes no list too short at once. They follow
    the longest of the last ``WINDOW`` lists, so that room shrinks as splats do. A list that is
    longer than its room loses its end, once: the next guess knows.

    Attributes:
        overflows: how many lists have lost their end.
    """

    def __init__(self) -> None:
        self.overflows = 0
        self._shares: dict[Hashable, deque[float]] = {}
        self._news: dict[Hashable, list[_News]] = {}

    def find(self, length: Tensor, kind: Hashable, rows: int, exact: bool) -> int:
        """Return the room for a list, at least 1.

        Args:
            length: () int64, of the list, on its device.
            kind: lists of one kind have similar lengths per row.
            rows: what the list is made from, at least 1.
            exact: wait for the length; so is the first of its kind.
        """
        if exact:
            return max(int(length), 1)
        kind = length.device, kind
        recorded = recording.is_recording()
        if not recorded:  # while a stream is captured no event may be asked
            self._read(kind)
        shares = self._shares.setdefault(kind, deque(maxlen=WINDOW))
        if not any(shares):
            shares.append(int(length) / rows)
        room = _rounded(MARGIN * max(shares) * rows)
        if recorded:
            recording.follow(_Recorded(self, kind, length, rows, room))
        else:
            self._send(kind, length, rows, room)
        return room

    def _send(self, kind: Hashable, length: Tensor, rows: int, room: int) -> None:
        self._news.setdefault(kind, []).append(_send(length, rows, room))

    def _read(self, kind: Hashable) -> None:
        """Learn from the lengths that have arrived."""
        news = self._news.get(kind, [])
        while news and (news[0].arrived is None or news[0].arrived.query()):
            length, _, rows, room = news.pop(0)
            self.overflows += int(length) > room
            self._shares[kind].append(int(length) / rows)


class _Recorded(NamedTuple):
    """A list of a recorded step, whose room stays what it was; see ``recording.Followed``."""

    rooms: Room
    kind: Hashable
    length: Tensor
    rows: int
    room: int

    def is_good(self) -> bool:
        """Return whether the longest of the last lists has room."""
        self.rooms._read(self.kind)
        return max(self.rooms._shares[self.kind]) * self.rows <= self.room

    def replayed(self) -> None:
        """Let the length come from the GPU."""
        self.rooms._send(self.kind, self.length, self.rows, self.room)


def _send(length: Tensor, rows: int, room: int) -> _News:
    if not length.is_cuda:
        return _News(length, None, rows, room)
    place = torch.empty((), dtype=length.dtype, pin_memory=True)
    place.copy_(length, non_blocking=True)
    arrived = torch.cuda.Event()
    arrived.record()
    return _News(place, arrived, rows, room)


def _rounded(length: float) -> int:
    """Return a room of one of few sizes not below ``length``, so that memory is used again."""
    wanted = max(length, LEAST)
    step = 1 << (math.floor(math.log2(wanted)) - 3)
    return math.ceil(wanted / step) * step
