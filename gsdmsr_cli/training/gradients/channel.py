"""Connects a training with a worker process: orders go out, gradients come back.

A forked process gets its orders over a pipe; model and gradients lie in memory that both share.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple, Protocol

import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.parent import end_with_parent
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.scene.native import one_opencv_thread
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.gradients.renderer import TrainingRenderer
from gsdmsr_cli.training.gradients.shared_buffers import SharedBuffers

_ON_SCREEN = "on screen"

GRACE_SECONDS = 0.5
"""A worker is killed if it does not end by itself within so long."""


class Channel(Protocol):
    """The training's end of the connection to one worker."""

    def wait(self) -> None:
        """Wait until the worker can take its first orders."""

    def send(self, model: Model, orders: Sequence[Order], phase: Phase) -> None:
        """Let the worker render views of the model as it is now, and go on at once."""

    def receive(self, model: Model) -> list[ViewGradients]:
        """Wait for the answers to the last orders; they are good until the next ones."""

    def close(self) -> None:
        """Let the worker end."""


class _Sizes(NamedTuple):
    """How large a model is.

    Attributes:
        splats: how many there are.
        moving: how many of them move.
        shapes: of the model's tensors in their order: an event may change those of any.
    """

    splats: int
    moving: int
    shapes: tuple[tuple[int, ...], ...]


@dataclass(frozen=True)
class _Task:
    """What goes to a worker; tensors as arrays, for torch would put them into files.

    Attributes:
        sizes: how large the model is, if that is new, else None.
        phase: its mask as an array.
        orders: see ``Order``, tile weights as arrays.
    """

    sizes: _Sizes | None
    phase: Phase
    orders: Sequence[Order]


@dataclass(frozen=True)
class _Answer:
    """A view's answer, whose gradients lie in shared memory where ``there`` says so."""

    loss: float
    there: Sequence[bool]
    size: tuple[int, int]
    tile_errors: NDArray[Any] | None


class ForkedChannel:
    """Reaches a worker that is a forked process of this one.

    Args:
        renderer: renders the worker's views.
        model: whose tensors are shared.
        published: where the training keeps the model's tensors.
        capacity: most splats that there will be.
        views: most views of an order.
        earlier: channels that are there already: their pipes must not live on in the new process.
        prepare: what the worker does before its first orders.
    """

    def __init__(
        self,
        renderer: TrainingRenderer,
        model: Model,
        published: SharedBuffers,
        capacity: int,
        views: int,
        earlier: Sequence[ForkedChannel],
        prepare: Callable[[], object],
    ) -> None:
        trained = [p for p in model.parameters() if p.rate is not None]
        self._answers = [SharedBuffers(trained, capacity, {_ON_SCREEN: 2}) for _ in range(views)]
        self._published = published
        self._ready = False
        self._sizes: _Sizes | None = None
        self._pipe, theirs = multiprocessing.Pipe()
        worker = _Worker(renderer, model, published, self._answers)
        # a copy of this end in any worker would keep that worker from noticing the training's end
        given = theirs, [*(channel._pipe for channel in earlier), self._pipe], worker, prepare
        context = multiprocessing.get_context("fork")
        self._process: BaseProcess = context.Process(target=_serve, args=given, daemon=True)
        with one_opencv_thread():
            self._process.start()
        theirs.close()

    def wait(self) -> None:
        """Wait until the worker can take its first orders."""
        if not self._ready:
            self._receive()
            self._ready = True

    def send(self, model: Model, orders: Sequence[Order], phase: Phase) -> None:
        """Let the worker render views of the model, whose tensors have been published."""
        self.wait()
        shapes = tuple(tuple(parameter.tensor.shape) for parameter in model.parameters())
        sizes = _Sizes(len(model.splats), model.moving, shapes)
        news = None if sizes == self._sizes else sizes
        self._sizes = sizes
        task = _Task(
            news, phase._replace(gradient_mask=_sent(phase.gradient_mask)),
            [order._replace(tile_weights=_sent(order.tile_weights)) for order in orders],
        )  # fmt: skip
        try:
            self._pipe.send(task)
        except OSError as error:
            raise self._has_ended() from error

    def receive(self, model: Model) -> list[ViewGradients]:
        """Wait for the answers to the last orders.

        Raises:
            GsdmsrError: the worker has ended.
            Exception: what went wrong in the worker.
        """
        shapes = {name: tensor.shape for name, tensor in model.trained().items()}
        found = []
        for answer, buffers in zip(self._receive(), self._answers, strict=False):
            gradients = [
                buffers.tensor(name, shape) if there else None
                for there, (name, shape) in zip(answer.there, shapes.items(), strict=True)
            ]
            on_screen = buffers.tensor(_ON_SCREEN, (len(model.splats), 2))
            errors, loss = _received(answer.tile_errors), torch.tensor(answer.loss)
            found.append(ViewGradients(loss, gradients, on_screen, answer.size, errors))
        return found

    def _receive(self) -> list[_Answer]:
        try:
            answer = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise self._has_ended() from error
        if isinstance(answer, Exception):
            raise answer
        answers: list[_Answer] = answer
        return answers

    def close(self) -> None:
        """Let the worker end; one that does not is killed."""
        self._pipe.close()
        self._process.join(timeout=GRACE_SECONDS)
        if self._process.is_alive():  # it compiles, or draws a large picture
            self._process.kill()
            self._process.join()

    def _has_ended(self) -> GsdmsrError:
        self._process.join(timeout=1)
        return GsdmsrError(
            f"a worker process of the training has ended (exit code {self._process.exitcode}); "
            "the last checkpoint is kept; --threads 1 trains without workers"
        )


class _Worker:
    """What a worker process works with."""

    def __init__(
        self,
        renderer: TrainingRenderer,
        model: Model,
        published: SharedBuffers,
        answers: Sequence[SharedBuffers],
    ) -> None:
        self._published, self._answers = published, answers
        self._renderer, self._model = renderer, model

    def do(self, task: _Task) -> list[_Answer]:
        """Render the task's views and go backward."""
        model = self._model
        if task.sizes is not None:
            model.become(task.sizes.splats, task.sizes.moving)
            self._published.attach(model, task.sizes.shapes)
        model.advance(task.phase.progress)
        phase = task.phase._replace(gradient_mask=_received(task.phase.gradient_mask))
        answers = []
        for sent, buffers in zip(task.orders, self._answers, strict=False):
            order = sent._replace(tile_weights=_received(sent.tile_weights))
            (found,) = self._renderer.gradients(model, [order], phase)
            answers.append(self._answer(found, buffers))
        return answers

    def _answer(self, found: ViewGradients, buffers: SharedBuffers) -> _Answer:
        gradients = dict(zip(self._model.trained(), found.gradients, strict=True))
        gradients[_ON_SCREEN] = found.on_screen
        buffers.write({name: tensor for name, tensor in gradients.items() if tensor is not None})
        there = [tensor is not None for tensor in found.gradients]
        return _Answer(found.loss.item(), there, found.size, _sent(found.tile_errors))


def _sent(tensor: Tensor | None) -> Any:
    return None if tensor is None else tensor.numpy()


def _received(array: Any) -> Tensor | None:
    return None if array is None else torch.from_numpy(array)


def _serve(
    pipe: Connection,
    foreign: Sequence[Connection],
    worker: _Worker,
    prepare: Callable[[], object],
) -> None:
    """Do one task after another in a worker, until the training closes the pipe or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training to deal with
    end_with_parent(os.getppid())  # even while it compiles
    torch.set_num_threads(1)  # torch's own threads have not come along
    for other in foreign:
        other.close()
    with contextlib.suppress(EOFError, OSError):
        try:
            prepare()
            pipe.send([])
            while True:
                pipe.send(worker.do(pipe.recv()))
        except GsdmsrError as error:
            pipe.send(error)
        except (EOFError, OSError):
            raise
        except Exception:
            pipe.send(RuntimeError(traceback.format_exc()))
