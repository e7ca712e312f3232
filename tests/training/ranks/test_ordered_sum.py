"""Sums over ranks: in the views' order to the last bit, whatever the number of ranks."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from queue import Queue
from typing import Any, cast

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsdmsr_cli.training.ranks.link import Link
from gsdmsr_cli.training.ranks.ordered_sum import shares, sum_in_order

SHAPES = (5, 3), (4,), (1,)


class Threads:
    """A link whose ranks are threads of this process."""

    def __init__(self, rank: int, mail: list[list[Queue[Tensor]]]) -> None:
        self.rank, self.size, self._mail = rank, len(mail), mail

    def gather(self, own: Tensor) -> list[Tensor]:
        return self.deal(own[None, None].expand(self.size, 1, -1), [1] * self.size, flat=True)

    def deal(self, parts: Tensor, rows: Sequence[int], flat: bool = False) -> list[Tensor]:
        for to in range(self.size):
            self._mail[to][self.rank].put(parts[to].clone())
        found = [box.get(timeout=20) for box in self._mail[self.rank]]
        assert [len(piece) for piece in found] == list(rows)
        return [piece[0] for piece in found] if flat else found


def on_ranks(views: Sequence[Sequence[Tensor | None]], ranks: int) -> list[list[Tensor]]:
    """Return what each rank gets as the sum."""
    mail = [[Queue[Tensor]() for _ in range(ranks)] for _ in range(ranks)]
    like = [torch.zeros(shape) for shape in SHAPES]
    found: dict[int, list[Tensor]] = {}

    def work(rank: int) -> None:
        link = cast(Link, cast(Any, Threads(rank, mail)))
        found[rank] = sum_in_order(link, views[rank::ranks], like, len(views))

    threads = [threading.Thread(target=work, args=[rank]) for rank in range(ranks)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=30)
    return [found[rank] for rank in range(ranks)]


def bits(tensor: Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()


@settings(deadline=None, max_examples=25)
@given(views=st.integers(1, 7), ranks=st.integers(1, 5), seed=st.integers(0, 999))
def test_sums_are_those_of_one_process_to_the_last_bit(views: int, ranks: int, seed: int) -> None:
    if ranks > views:
        return
    rng = torch.Generator().manual_seed(seed)

    def gradient(shape: tuple[int, ...]) -> Tensor | None:
        value = 10 ** torch.randn(shape, generator=rng) * torch.randn(shape, generator=rng)
        value[torch.rand(shape, generator=rng) < 0.2] = -0.0
        value[torch.rand(shape, generator=rng) < 0.1] = torch.inf
        return None if torch.rand((), generator=rng) < 0.3 else value

    given_views = [[gradient(shape) for shape in SHAPES] for _ in range(views)]
    expected = []
    for place, shape in enumerate(SHAPES):
        there = [view[place] for view in given_views if view[place] is not None]
        total = torch.full(shape, -0.0)
        for number, part in enumerate(there):
            assert part is not None
            total = part if number == 0 else total + part
        expected.append(total)
    for found in on_ranks(given_views, ranks):
        assert [bits(t) for t in found] == [bits(t) for t in expected]


def test_the_order_matters() -> None:
    """So that the test above compares something."""
    big, small = torch.tensor([1e8]), torch.tensor([1.0])
    assert (big + small) - big != (big - big) + small
    views = [[torch.full(s, v) for s in SHAPES] for v in (1e8, 1.0, -1e8)]
    (found, *_), *_ = on_ranks(views, 3)
    assert torch.equal(found, torch.full(SHAPES[0], (big + small - big).item()))


@pytest.mark.parametrize(("views", "ranks"), [(1, 1), (7, 3), (4, 4), (16, 5)])
def test_every_view_is_one_ranks(views: int, ranks: int) -> None:
    found = shares(views, ranks)
    assert sum(found) == views and max(found) - min(found) <= 1
    assert found == [len(range(views)[rank::ranks]) for rank in range(ranks)]
