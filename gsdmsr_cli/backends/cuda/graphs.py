"""Records work on a GPU as a CUDA graph, which one call replays.

What differs from one replay to the next is in structures of arguments, which are written anew, and
handed to the launches that were given them. Nothing else of the graph changes.
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Generic, NamedTuple, TypeVar

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import launch, recording
from gsdmsr_cli.backends.cuda.driver import Driver

T = TypeVar("T")


class _Node(NamedTuple):
    """A launch of the graph whose arguments differ."""

    handle: int
    launched: recording.Launched


class Recording(Generic[T]):
    """Work that has been recorded, and what it returned: the same tensors after every replay."""

    def __init__(self, driver: Driver, device: torch.device, inputs: Any) -> None:
        self._driver, self._device, self._inputs = driver, device, inputs
        self._graph = torch.cuda.CUDAGraph(keep_graph=True)
        self._executable: int | None = None
        self._varied: list[tuple[ctypes.Structure, recording.Fill]] = []
        self._addresses: set[int] = set()
        self._kept: list[Tensor] = []
        self._followed: list[recording.Followed] = []
        self._nodes: list[_Node] = []
        self._results: T

    def listens(self) -> bool:
        """Return whether this thread works on the stream that is captured.

        Autograd's does; one that draws what a page shows does not.
        """
        return torch.cuda.is_current_stream_capturing()

    def vary(self, structure: ctypes.Structure, fill: recording.Fill) -> None:
        """See ``recording.vary``.

        Raises:
            ValueError: what is in the structure is not what the present inputs make of it.
        """
        before = bytes(structure)
        fill(structure, self._inputs)
        if bytes(structure) != before:
            raise ValueError(f"{type(structure).__name__} differs from what inputs make of it")
        self._varied.append((structure, fill))
        self._addresses.add(ctypes.addressof(structure))

    def keep(self, tensor: Tensor) -> None:
        """See ``recording.keep``."""
        self._kept.append(tensor)

    def follow(self, what: recording.Followed) -> None:
        """See ``recording.follow``."""
        self._followed.append(what)

    def launched(self, launched: recording.Launched) -> None:
        """Note which launch of the graph was given what differs."""
        if self._addresses.intersection(launched.arguments):
            self._nodes.append(_Node(self._driver.last_node(launched.device), launched))

    def capture(self, work: Callable[[], T], stream: torch.cuda.Stream, pool: Any) -> None:
        """Record what ``work`` launches, which does not run before the first replay."""
        with _no_garbage_collected(), torch.cuda.stream(stream), recording.recorded_by(self):
            self._graph.capture_begin(pool=pool, capture_error_mode="thread_local")
            try:
                self._results = work()
            except BaseException:
                with suppress(RuntimeError):  # says that there was an error, and not which
                    self._graph.capture_end()
                raise
            self._graph.capture_end()
        # nodes are those of this graph, so torch must not make one that can be executed of it
        self._executable = self._driver.instantiate(self._graph.raw_cuda_graph(), self._device)

    def is_good(self) -> bool:
        """Return whether it may be replayed once more."""
        return all(what.is_good() for what in self._followed)

    def replay(self, inputs: Any) -> T:
        """Run the work with other inputs; return its results, good until the next replay."""
        assert self._executable is not None
        for structure, fill in self._varied:
            fill(structure, inputs)
        for node in self._nodes:
            self._driver.give_node(self._executable, *node)
        self._driver.execute(self._executable, self._device)
        for what in self._followed:
            what.replayed()
        return self._results

    def __del__(self) -> None:
        if self._executable is not None:
            self._driver.destroy(self._executable)


@contextmanager
def _no_garbage_collected() -> Iterator[None]:
    """Keep Python from collecting garbage, on any thread, until the block ends.

    What it finds may be an earlier training's recording. To let go of one while a stream is
    captured is an error of that capture.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class GraphRecorder:
    """Records work that runs on torch's present device, one recording after the other.

    All recordings share one pool of memory, so an earlier one must not be replayed any more.
    """

    def __init__(self, device: torch.device) -> None:
        self._device, self._driver = device, launch.driver()
        self._place: _Place | None = None

    def record(self, work: Callable[[], T], inputs: Any) -> Recording[T]:
        """Record what ``work`` launches, whose present inputs these are.

        Raises:
            ValueError: the work reads something else than its inputs.
            RuntimeError: torch cannot capture it.
            GsdmsrError: the driver refuses.
        """
        if self._place is None:
            place = _Place(self._device)
            place.warm_up(work)
            self._place = place
        made: Recording[T] = Recording(self._driver, self._device, inputs)
        made.capture(work, self._place.stream, self._place.pool)
        return made


class _Place:
    """Where work is captured.

    Attributes:
        stream: beside torch's own.
        pool: of memory, for all recordings.
    """

    def __init__(self, device: torch.device) -> None:
        self._device, self.stream = device, torch.cuda.Stream(device)
        self.pool = torch.cuda.graph_pool_handle()
        self._anchor = torch.cuda.CUDAGraph()  # a pool that no graph has is gone
        with _no_garbage_collected(), torch.cuda.stream(self.stream):
            some = torch.zeros(1, device=device)
            self._anchor.capture_begin(pool=self.pool, capture_error_mode="thread_local")
            some.add_(1)
            self._anchor.capture_end()

    def warm_up(self, work: Callable[[], object]) -> None:
        """Do the work once where it will be captured, so that libraries have made what they need.

        What they take while they are captured would belong to that recording.
        """
        now = torch.cuda.current_stream(self._device)
        self.stream.wait_stream(now)
        with torch.cuda.stream(self.stream):
            work()
        now.wait_stream(self.stream)


def can_record() -> bool:
    """Return whether torch lets go of a captured graph's handle: since 2.8."""
    return hasattr(torch.cuda.CUDAGraph, "raw_cuda_graph")
