"""Arrays of bytes by number, in bounded memory that a process shares with those it forks."""

from __future__ import annotations

import contextlib
import mmap
import os
import sys
import threading
import weakref
from collections.abc import Collection, Iterable, Iterator
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import UsageError

if sys.platform.startswith("linux"):
    import fcntl

BLOCK = max(1 << 15, mmap.PAGESIZE)
"""Size of a block [bytes]. Larger ones waste more of the last block of an array, smaller ones make
the table longer, which is searched when an array is missed."""

_ROW = 3 * 8
"""Bytes of the table per block: name, last use, last change."""

_NEVER = np.iinfo(np.int64).max
_FREE = 0


class BlockStore:
    """Keeps arrays under numbers; the least recently used ones make room for new ones.

    The memory, its table included, never exceeds the limit. All processes forked from the one that
    made the store use the same memory: what one has put, all can get. Safe to use from any thread.

    An array lies in blocks that need not be neighbours, in ascending order. All blocks of an array
    carry its number; it counts as absent while any of its blocks is missing. Blocks are freed
    before they are written and numbered afterwards, so a process that dies while it writes leaves
    free blocks. The lock is the kernel's, which opens it when its process dies. It is held while
    an array is written, but not while one is read: a reader copies, then checks whether the blocks
    have been changed meanwhile.

    On other systems than Linux the memory serves the threads of one process.

    Args:
        limit_bytes: size of the memory; the system gives it when it is first written.

    Raises:
        UsageError: the system refuses so much.
    """

    def __init__(self, limit_bytes: int) -> None:
        self._count = max(0, limit_bytes - 8) // (BLOCK + _ROW)
        data_bytes = self._count * BLOCK
        self._memory, self._file = _allocate(data_bytes + self._count * _ROW + 8)
        if self._file is not None:
            weakref.finalize(self, os.close, self._file)
        self._data = np.ndarray((self._count, BLOCK), np.uint8, self._memory)
        table = np.ndarray((3 * self._count + 1,), np.int64, self._memory, data_bytes)
        self._clock = table[:1]
        self._numbers, self._used, self._changed = table[1:].reshape(3, self._count)
        self._used[:] = _NEVER
        self._places: dict[int, NDArray[np.intp]] = {}  # where arrays were found last
        self._threads = threading.Lock()

    def get(self, number: int, size: int) -> NDArray[np.uint8] | None:
        """Return a copy of the array of this number and size [bytes], (size,), or None.

        Numbers are of 64 bits with sign, and not 0.
        """
        with self._locked():
            rows = self._find(number, size)
            if rows is None:
                return None
            self._used[rows] = self._tick()
            before = self._changed[rows]
        copy = self._data[rows].reshape(-1)[:size]
        with self._locked():
            unchanged = np.array_equal(self._changed[rows], before)
        return copy if unchanged else None

    def put(self, number: int, content: NDArray[np.uint8]) -> None:
        """Keep a copy of the array (size,), unless it is larger than the whole memory."""
        needed = blocks(content.size)
        if needed > self._count:
            return
        with self._locked():
            if self._find(number, content.size) is not None:
                return  # another thread or process was faster
            self._free(self._numbers == number)
            rows = self._make_room(needed)
            self._changed[rows] = self._tick()
            whole = content.size // BLOCK
            self._data[rows[:whole]] = content[: whole * BLOCK].reshape(whole, BLOCK)
            if whole < needed:
                self._data[rows[whole], : content.size - whole * BLOCK] = content[whole * BLOCK :]
            self._used[rows] = self._tick()
            self._numbers[rows] = number
            self._places[number] = rows

    def drop(self, numbers: Collection[int]) -> None:
        """Drop the arrays of these numbers and return their memory to the system, if it can."""
        with self._locked():
            dropped = np.isin(self._numbers, list(numbers))
            self._free(dropped)
            if not hasattr(mmap, "MADV_REMOVE"):
                return
            edges = np.flatnonzero(np.diff(dropped, prepend=False, append=False))
            for start, end in edges.reshape(-1, 2).tolist():
                self._memory.madvise(mmap.MADV_REMOVE, start * BLOCK, (end - start) * BLOCK)

    def fitting(self, sizes: Iterable[int]) -> int:
        """Return how many arrays of these sizes [bytes], from the first on, fit in together."""
        return sum(end <= self._count for end in accumulate(map(blocks, sizes)))

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Keep other threads and other processes out."""
        with self._threads:
            if self._file is None:
                yield
                return
            fcntl.lockf(self._file, fcntl.LOCK_EX)
            try:
                yield
            finally:
                fcntl.lockf(self._file, fcntl.LOCK_UN)

    def _tick(self) -> int:
        """Return a time later than all before."""
        self._clock += 1
        return int(self._clock[0])

    def _find(self, number: int, size: int) -> NDArray[np.intp] | None:
        """Return the blocks of an array, or None if it is not there as a whole."""
        rows = self._places.get(number)
        if rows is None or (self._numbers[rows] != number).any():
            rows = np.flatnonzero(self._numbers == number)
            self._places[number] = rows
        return rows if len(rows) == blocks(size) else None

    def _make_room(self, needed: int) -> NDArray[np.intp]:
        """Return free blocks, after the least recently used arrays have gone as far as need be."""
        while True:
            rows = np.flatnonzero(self._numbers == _FREE)
            if len(rows) >= needed:
                return rows[:needed].copy()  # a view would keep them all, for each array
            oldest = self._numbers[self._used.argmin()]
            self._free(self._numbers == oldest)

    def _free(self, blocks: NDArray[np.bool_]) -> None:
        """Free these blocks of all."""
        self._changed[blocks] = self._tick()
        self._numbers[blocks] = _FREE
        self._used[blocks] = _NEVER


def blocks(size: int) -> int:
    """Return how many blocks an array of ``size`` bytes takes."""
    return -(-size // BLOCK)


def _allocate(size: int) -> tuple[mmap.mmap, int | None]:
    """Return memory that forked processes share and, on Linux, its file, which has no name."""
    try:
        if not sys.platform.startswith("linux"):
            return mmap.mmap(-1, size), None
        file = os.memfd_create("gsdmsr-pictures")
        os.ftruncate(file, size)  # takes no memory before it is written
        return mmap.mmap(file, size), file
    except OSError as error:
        raise UsageError(
            f"the system refuses {size >> 20} MiB for pictures ({error.strerror}); "
            "lower data.cache_mib"
        ) from error
