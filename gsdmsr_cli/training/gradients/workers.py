"""Takes the gradients of several views at once, each in a process of its own.

The kernels of one view are too short to keep two cores busy, and the Python between them runs on
one. Two processes, each with a view and a core, get more views done in the same time. The
gradients of a view are the same in every process, so a training gives the same result with and
without workers.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.training.gradients.channel import Channel, ForkedChannel
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.gradients.renderer import TrainingRenderer
from gsdmsr_cli.training.gradients.shared_buffers import SharedBuffers

T = TypeVar("T")


def processes_for(views: int) -> int:
    """Return how many processes share a step's views, as far as there are threads for them."""
    forks = sys.platform.startswith("linux") and jit.may_fork()
    return min(views, jit.threads()) if forks else 1


class WorkerPool:
    """This process and its workers, if it has any; without, it renders all views by itself.

    Attributes:
        renderer: how all of them render.
    """

    def __init__(self, renderer: TrainingRenderer) -> None:
        self.renderer = renderer
        self._channels: list[Channel] = []
        self._published: SharedBuffers
        self._threads = 0

    def __len__(self) -> int:
        return 1 + len(self._channels)

    def start(self, model: Model, capacity: int, views: int, prepare: Callable[[], object]) -> None:
        """Start a worker for every further view of a step, as far as there are threads.

        All processes share the threads evenly. There is none where processes cannot be forked
        safely: on other systems than Linux, or with OpenMP below the kernels. To be called before
        this process takes any gradient: builds of torch with CUDA start threads for those.

        Args:
            model: whose tensors are shared.
            capacity: most splats there will be.
            views: how many are rendered in a step.
            prepare: what each worker does before its first orders.
        """
        self._threads = jit.threads()
        count = processes_for(views)
        if count < 2:
            return
        jit.set_threads(self._threads // count)
        self._published = SharedBuffers(model.parameters(), capacity)
        channels: list[ForkedChannel] = []
        for worker in range(1, count):
            share = len(range(worker, views, count))
            given = self.renderer, model, self._published, capacity, share
            channels.append(ForkedChannel(*given, tuple(channels), prepare))
        self._channels = [*channels]

    def wait(self) -> None:
        """Wait until all workers have prepared themselves."""
        for channel in self._channels:
            channel.wait()

    def gradients(
        self,
        model: Model,
        orders: Sequence[Order],
        phase: Phase,
        meanwhile: Callable[[], T],
    ) -> tuple[list[ViewGradients], T]:
        """Return the gradients of the ordered views, in their order.

        ``meanwhile`` is called when this process has done its share and workers may not have; what
        it returns is returned as well. The gradients are only good until the next call.

        Raises:
            GsdmsrError: a worker has ended.
            DataError: a picture cannot be read.
        """
        shares = [orders[i :: len(self)] for i in range(len(self))]
        busy = [pair for pair in zip(self._channels, shares[1:], strict=True) if pair[1]]
        if busy:
            self._published.publish(model)
        for channel, share in busy:
            channel.send(model, share, phase)
        own = self.renderer.gradients(model, shares[0], phase)
        other = meanwhile()
        found = [own] + [channel.receive(model) for channel, _ in busy]
        return [found[i % len(self)][i // len(self)] for i in range(len(orders))], other

    @contextlib.contextmanager
    def all_threads(self) -> Iterator[None]:
        """Use the workers' threads as well, while they have nothing to do."""
        own = jit.threads()
        if self._channels:
            jit.set_threads(self._threads)
        try:
            yield
        finally:
            jit.set_threads(own)

    def stop(self) -> None:
        """Let the workers end, and give their threads back to this process."""
        if self._channels:
            jit.set_threads(self._threads)
        for channel in self._channels:
            channel.close()
        self._channels = []
