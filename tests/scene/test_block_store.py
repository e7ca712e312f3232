"""Shared bounded memory: right bytes, least recently used first, and robust against deaths."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tracemalloc
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.scene.block_store import BLOCK, BlockStore

ROW = BLOCK + 32
"""Memory for a block, with its row of the table."""

needs_sharing = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="processes share a store on Linux only"
)


def content(number: int, size: int) -> NDArray[np.uint8]:
    return np.random.default_rng(abs(number)).integers(0, 256, size, np.uint8)


def in_a_child(work: Callable[[], object]) -> int | None:
    """Return the exit code of a forked process that has done this."""
    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    child.join(timeout=30)
    assert child.exitcode is not None, "it waits for ever"
    return child.exitcode


@pytest.mark.parametrize("size", [1, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK])
def test_what_was_put_is_got_as_a_copy(size: int) -> None:
    store = BlockStore(5 * ROW)
    assert store.get(7, size) is None
    store.put(7, content(7, size))
    found = store.get(7, size)
    assert found is not None and found.shape == (size,)
    assert (found == content(7, size)).all()
    found[:] = 0
    again = store.get(7, size)
    assert again is not None and (again == content(7, size)).all()


sizes = st.integers(1, 3 * BLOCK)
steps = st.lists(st.tuples(st.sampled_from("pgd"), st.integers(1, 6)), max_size=40)


@given(sizes=st.lists(sizes, min_size=6, max_size=6), steps=steps, blocks=st.integers(0, 7))
def test_it_keeps_what_was_used_last(
    sizes: list[int], steps: list[tuple[str, int]], blocks: int
) -> None:
    """Against a dictionary in the order of use."""
    store = BlockStore(blocks * ROW)
    kept: OrderedDict[int, int] = OrderedDict()
    for verb, number in steps:
        size = sizes[number - 1]
        needed = -(-size // BLOCK)
        if verb == "p":
            store.put(number, content(number, size))
            if number not in kept and needed <= blocks:
                while sum(kept.values()) + needed > blocks:
                    kept.popitem(last=False)
                kept[number] = needed
        elif verb == "d":
            store.drop([number])
            kept.pop(number, None)
        else:
            found = store.get(number, size)
            assert (found is not None) == (number in kept)
            if found is not None:
                assert (found == content(number, size)).all()
                kept.move_to_end(number)


def test_the_limit_includes_the_table() -> None:
    store = BlockStore(1 << 20)
    assert len(store._memory) <= 1 << 20
    assert store.fitting([BLOCK] * 100) == (1 << 20) // ROW == 31


def test_fitting_counts_whole_blocks_from_the_first() -> None:
    store = BlockStore(4 * ROW)
    assert store.fitting([1, 2 * BLOCK, 1, 1]) == 3
    assert store.fitting([5 * BLOCK, 1]) == 0
    assert BlockStore(0).fitting([1]) == 0


def test_more_than_the_system_has_is_a_mistake_of_the_user() -> None:
    with pytest.raises(UsageError, match=r"MiB for pictures .*lower data\.cache_mib"):
        BlockStore(1 << 62)


def test_threads_never_see_half_of_an_array() -> None:
    """More arrays than fit, of different sizes, put and got all at once."""
    store = BlockStore(6 * ROW)

    def work(seed: int) -> int:
        found = 0
        for number in np.random.default_rng(seed).integers(1, 9, 300).tolist():
            expected = expectations[number]
            got = store.get(number, expected.size)
            if got is None:
                store.put(number, expected)
            else:
                assert (got == expected).all()
                found += 1
        return found

    expectations = {number: content(number, number * BLOCK // 2) for number in range(1, 9)}
    with ThreadPoolExecutor(4) as pool:
        assert min(pool.map(work, range(4))) > 0


def test_an_array_that_goes_while_it_is_copied_is_not_returned() -> None:
    store = BlockStore(2 * ROW)
    store.put(1, content(1, 2 * BLOCK))

    class Slow:
        """Blocks that are overwritten just when they are copied."""

        def __getitem__(self, rows: NDArray[np.intp]) -> NDArray[np.uint8]:
            store._data = data
            store.put(2, content(2, 2 * BLOCK))
            return data[rows]

    data, store._data = store._data, Slow()  # type: ignore[assignment]
    assert store.get(1, 2 * BLOCK) is None
    found = store.get(2, 2 * BLOCK)
    assert found is not None and (found == content(2, 2 * BLOCK)).all()


@needs_sharing
def test_forked_processes_share_what_any_of_them_puts() -> None:
    store = BlockStore(4 * ROW)
    store.put(1, content(1, BLOCK))

    def child() -> None:
        found = store.get(1, BLOCK)
        assert found is not None and (found == content(1, BLOCK)).all()
        store.put(2, content(2, 2 * BLOCK))
        store.drop([1])

    assert in_a_child(child) == 0
    found = store.get(2, 2 * BLOCK)
    assert found is not None and (found == content(2, 2 * BLOCK)).all()
    assert store.get(1, BLOCK) is None


@needs_sharing
@pytest.mark.parametrize("deadly", [1, 2, 3])
def test_a_process_that_dies_while_it_puts_blocks_nobody(deadly: int) -> None:
    """Before blocks are freed, before they are written, and before they are numbered."""
    store = BlockStore(3 * ROW)
    store.put(1, content(1, 2 * BLOCK))
    calls = 0

    def child() -> None:
        def tick() -> int:
            nonlocal calls
            calls += 1
            if calls == deadly:
                os.kill(os.getpid(), signal.SIGKILL)
            return BlockStore._tick(store)

        store._tick = tick  # type: ignore[method-assign]
        store.put(2, content(2, 3 * BLOCK))

    assert in_a_child(child) == -signal.SIGKILL
    assert store.get(2, 3 * BLOCK) is None

    def other() -> None:
        for number in (3, 2):
            store.put(number, content(number, 3 * BLOCK))
            found = store.get(number, 3 * BLOCK)
            assert found is not None and (found == content(number, 3 * BLOCK)).all()

    assert in_a_child(other) == 0
    other()


@needs_sharing
def test_one_process_waits_while_another_writes() -> None:
    """Two processes that put and get for a while, in memory for half of it."""
    store = BlockStore(8 * ROW)
    expectations = {number: content(number, 2 * BLOCK) for number in range(1, 9)}

    def work() -> None:
        for number in np.random.default_rng(os.getpid()).integers(1, 9, 2000).tolist():
            got = store.get(number, 2 * BLOCK)
            if got is None:
                store.put(number, expectations[number])
            else:
                assert (got == expectations[number]).all()

    context = multiprocessing.get_context("fork")
    children = [context.Process(target=work) for _ in range(2)]
    for child in children:
        child.start()
    work()
    for child in children:
        child.join(timeout=60)
    assert [child.exitcode for child in children] == [0, 0]


def test_what_is_known_of_places_grows_with_the_arrays_and_not_with_the_memory() -> None:
    store, count = BlockStore(64 << 20), 500
    store.put(1, content(1, BLOCK))
    tracemalloc.start()
    try:
        for number in range(2, count + 2):
            store.put(number, content(1, BLOCK))
        held = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert held < 500 * count
