"""The connection of one rank to the others: what goes over the network, and what that costs."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor, distributed

from gsdmsr_cli.ground.errors import GsdmsrError

T = TypeVar("T")


class Link:
    """The other ranks, through a process group of ``torch.distributed`` that has been joined.

    All of them call the same methods in the same order.

    Attributes:
        rank, size: see ``Ranks``.
        seconds: spent here, waiting for slower ranks included [s].
        received: bytes that have come from other ranks.
    """

    def __init__(self) -> None:
        self.rank, self.size = distributed.get_rank(), distributed.get_world_size()
        self.seconds, self.received = 0.0, 0

    def gather(self, own: Tensor) -> list[Tensor]:
        """Return the tensors of all ranks, of one shape and dtype, in their order."""
        found = [torch.empty_like(own) for _ in range(self.size)]
        with self._counted(own.nbytes * (self.size - 1)):
            distributed.all_gather(found, own)
        return found

    def deal(self, parts: Tensor, shares: Sequence[int]) -> list[Tensor]:
        """Give every rank its part; return the parts that all ranks have for this one.

        Args:
            parts: (ranks, rows, columns), the part of each rank.
            shares: how many rows the parts of each rank have; columns are as many for all.

        Returns:
            Of each rank (its rows, columns).
        """
        columns, own = parts.shape[2], parts[0].numel()
        sizes = [rows * columns for rows in shares]
        found = parts.new_empty(sum(sizes))
        sent = parts.contiguous().flatten()
        foreign = sum(sizes) - sizes[self.rank]
        with self._counted(foreign * parts.itemsize):
            distributed.all_to_all_single(found, sent, sizes, [own] * self.size)
        return [piece.view(-1, columns) for piece in found.split(sizes)]

    def gather_objects(self, own: T) -> list[T]:
        """Return the objects of all ranks, in their order."""
        found: list[T | None] = [None] * self.size
        with self._counted(0):
            distributed.all_gather_object(found, own)
        return [value for value in found if value is not None]

    def told_by_first(self, own: T) -> T:
        """Return the object of the first rank; those of the others do not count."""
        told = [own]
        with self._counted(0):
            distributed.broadcast_object_list(told)
        return told[0]

    @contextmanager
    def _counted(self, foreign: int) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        except RuntimeError as error:
            reason = str(error).splitlines()[0][:200]
            raise GsdmsrError(
                f"rank {self.rank} on {platform.node()} has lost the connection to another rank "
                f"({reason}); the last checkpoint is kept; torchrun --max-restarts N, or the same "
                "command with --resume, goes on from it"
            ) from error
        self.seconds += time.perf_counter() - began
        self.received += foreign
