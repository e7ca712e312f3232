"""The ranks of a training that are connected by a process group."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import Any

import torch

from gsdmsr_cli.model.model import Model
from gsdmsr_cli.training.gradients.phase import Order, ViewGradients
from gsdmsr_cli.training.ranks.alone import RanksDifferError
from gsdmsr_cli.training.ranks.link import Link
from gsdmsr_cli.training.ranks.ordered_sum import sum_in_order
from gsdmsr_cli.training.ranks.telling import length_of, pack, unpack
from gsdmsr_cli.training.schedule import Clock

CHECK_EVERY = 100
"""Steps between two comparisons of the whole model; it is compared after every resize too."""


class Connected:
    """See ``Ranks``."""

    def __init__(self, link: Link) -> None:
        self.link, self.rank, self.size = link, link.rank, link.size
        self._sizes = 0, 0
        self._steps = 0
        self._seconds, self._received = link.seconds, link.received

    def share(self, orders: Sequence[Order]) -> Sequence[Order]:
        """Return every ``size``-th order, beginning with that of this rank."""
        return orders[self.rank :: self.size]

    def gather(
        self,
        model: Model,
        orders: Sequence[Order],
        own: Sequence[ViewGradients],
        with_screens: bool,
    ) -> list[ViewGradients]:
        """See ``Ranks``."""
        trained = list(model.trained().values())
        splats = len(model.splats) if with_screens else 0
        by_rank = [orders[rank :: self.size] for rank in range(self.size)]
        most = max(sum(length_of(o, len(trained), splats) for o in part) for part in by_rank)
        rows = self.link.gather(pack(own, by_rank[self.rank], with_screens, most))
        told = [
            unpack(row, part, len(trained), splats) for row, part in zip(rows, by_rank, strict=True)
        ]
        in_order = [told[i % self.size][i // self.size] for i in range(len(orders))]
        sums = sum_in_order(self.link, [v.gradients for v in own], trained, len(orders))
        there = [any(flags) for flags in zip(*(view.there for view in in_order), strict=True)]
        first = [value if known else None for value, known in zip(sums, there, strict=True)]
        nothing = [None] * len(trained)
        return [
            ViewGradients(v.loss, nothing if i else first, v.on_screen, v.size, v.tile_errors)
            for i, v in enumerate(in_order)
        ]

    def meet(
        self, clock: Clock, model: Model, generator: torch.Generator, end_wanted: bool
    ) -> bool:
        """See ``Ranks``."""
        sizes = len(model.splats), model.moving
        due = clock.step % CHECK_EVERY == 0 or sizes != self._sizes
        self._sizes, self._steps = sizes, self._steps + 1
        checksum = checksum_of(model, generator) if due else 0
        own = [clock.now, end_wanted, clock.step, *sizes, checksum]
        rows = [row.tolist() for row in self.link.gather(torch.tensor(own, dtype=torch.float64))]
        clock.told = rows[0][0]
        differing = [rank for rank, row in enumerate(rows) if row[2:] != rows[0][2:]]
        if differing:
            what = "at other steps" if any(r[2] != rows[0][2] for r in rows) else "other models"
            raise RanksDifferError(
                f"at step {clock.step} rank{'s' * (len(differing) > 1)} "
                f"{', '.join(map(str, differing))} and rank 0 hold {what}; all machines must have "
                "the same processor and the same versions; the last checkpoint is kept"
            )
        return any(row[1] for row in rows)

    def account(self) -> dict[str, Any]:
        """Return the number of ranks, and of this one the time and the traffic of the exchange."""
        steps = max(self._steps, 1)
        seconds = self.link.seconds - self._seconds
        received = self.link.received - self._received
        about = {
            "size": self.size,
            "exchange_s": round(seconds, 3),
            "exchange_ms_per_step": round(1000 * seconds / steps, 3),
            "received_mb_per_step": round(received / steps / 1e6, 4),
        }
        return {"ranks": about}


def checksum_of(model: Model, generator: torch.Generator) -> int:
    """Return the CRC-32 of all of a model's tensors and of the state of the random choices."""
    found = zlib.crc32(generator.get_state().numpy().data)
    for parameter in model.parameters():
        found = zlib.crc32(parameter.tensor.detach().cpu().contiguous().numpy().data, found)
    return found
