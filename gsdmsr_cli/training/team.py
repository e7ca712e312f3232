"""Several views of a step at once, each by a process of its own.

The kernels of one view are too short to keep two cores busy, and the Python between them runs on
one. Two processes, each with a view and a core, get more views done in the same time.
Helper processes are forked, so that they share the pictures; they are told over a pipe what to look
at, read the model from shared memory and answer there with the gradients. Gradients do not depend
on who has taken them, so a training gives the same result with and without helpers.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import multiprocessing
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.errors import GsdmsrError
from gsdmsr_cli.kernels import jit
from gsdmsr_cli.model import STORED, Model
from gsdmsr_cli.scene import View
from gsdmsr_cli.training.look import Look, Observer, Stage

T = TypeVar("T")

_ON_SCREEN = "on screen"


@dataclass(frozen=True)
class _Task:
    """What a helper is to look at.

    Attributes:
        sizes: how many splats there are and how many move, if that is new, else None.
        teachers, progress, moving: see ``Stage``.
        views: rows of the team's views.
        tile_weights: of each view, see ``Observer.look``.
    """

    sizes: tuple[int, int] | None
    teachers: NDArray[np.bool_] | None
    progress: float
    moving: bool
    views: Sequence[int]
    tile_weights: Sequence[NDArray[np.float32] | None]


@dataclass(frozen=True)
class _Answer:
    """A look whose gradients lie in shared memory, where ``there`` says so."""

    loss: float
    there: Sequence[bool]
    size: tuple[int, int]
    errors: NDArray[np.float64] | None


class Team:
    """This process and its helpers, if it has any; without, it looks at all views by itself.

    Attributes:
        observer: how all of them look.
        views: all views that may be looked at.
    """

    def __init__(self, observer: Observer, views: Sequence[View]) -> None:
        self.observer, self.views = observer, views
        self._helpers: list[_Helper] = []
        self._published: _Shelf
        self._threads = 0

    def __len__(self) -> int:
        return 1 + len(self._helpers)

    def hire(self, model: Model, capacity: int, views: int, prepare: Callable[[], object]) -> None:
        """Start a helper for every further view of a step, as far as there are threads.

        All processes share the threads evenly. There is none where processes cannot be forked
        safely: on other systems than Linux, or with OpenMP below the kernels. To be called before
        this process takes any gradient: builds of torch with CUDA start threads for those.

        Args:
            model: tells which tensors there are.
            capacity: most splats there will be.
            views: how many are looked at in a step.
            prepare: what each helper does before its first task.
        """
        self._threads = jit.threads()
        count = min(views, self._threads)
        if count < 2 or not sys.platform.startswith("linux") or not jit.may_fork():
            return
        jit.set_threads(self._threads // count)
        published = _Shelf(model, capacity)
        for helper in range(1, count):
            mine = len(range(helper, views, count))
            answers = [_Shelf(model, capacity, on_screen=True) for _ in range(mine)]
            desk = _Desk(self.observer, self.views, model, published, answers)
            self._helpers.append(_Helper(desk, [h.pipe for h in self._helpers], prepare))
        self._published = published

    def wait(self) -> None:
        """Wait until all helpers have prepared themselves."""
        for helper in self._helpers:
            helper.wait()

    def look(
        self,
        model: Model,
        rows: Sequence[int],
        stage: Stage,
        tile_weights: Sequence[Tensor | None],
        meanwhile: Callable[[], T],
    ) -> tuple[list[Look], T]:
        """Look at the views of these rows, in this order, each with its tile weights.

        ``meanwhile`` is called when this process has looked and helpers may not have; what it
        returns is returned as well. The gradients are only good until the next call.

        Raises:
            GsdmsrError: a helper has ended.
            DataError: a picture cannot be read.
        """
        views = list(zip(rows, tile_weights, strict=True))
        shares = [views[i :: len(self)] for i in range(len(self))]
        busy = [pair for pair in zip(self._helpers, shares[1:], strict=True) if pair[1]]
        if busy:
            self._published.hold(model)
        for helper, share in busy:
            helper.send(model, share, stage)
        own = self._look(model, shares[0], stage)
        other = meanwhile()
        looks = [own] + [helper.looks(model) for helper, _ in busy]
        return [looks[i % len(self)][i // len(self)] for i in range(len(rows))], other

    def _look(
        self, model: Model, share: Sequence[tuple[int, Tensor | None]], stage: Stage
    ) -> list[Look]:
        views, tile_weights = [self.views[row] for row, _ in share], [own for _, own in share]
        return self.observer.look(model, views, stage, tile_weights)

    @contextlib.contextmanager
    def all_threads(self) -> Iterator[None]:
        """Use the helpers' threads as well, while they have nothing to do."""
        own = jit.threads()
        if self._helpers:
            jit.set_threads(self._threads)
        try:
            yield
        finally:
            jit.set_threads(own)

    def dismiss(self) -> None:
        """Let the helpers go, and give their threads back to this process."""
        if self._helpers:
            jit.set_threads(self._threads)
        for helper in self._helpers:
            helper.end()
        self._helpers = []


class _Helper:
    """The training's side of a helper process."""

    def __init__(
        self, desk: _Desk, earlier: Sequence[Connection], prepare: Callable[[], object]
    ) -> None:
        self.answers = desk.answers
        self.ready = False
        self._told = (0, 0)
        self.pipe, theirs = multiprocessing.Pipe()
        # a copy of this end in any helper would keep that helper from noticing the training's end
        given = theirs, [*earlier, self.pipe], desk, prepare
        context = multiprocessing.get_context("fork")
        self.process: BaseProcess = context.Process(target=_serve, args=given, daemon=True)
        self.process.start()
        theirs.close()

    def wait(self) -> None:
        if not self.ready:
            self.receive()
            self.ready = True

    def send(self, model: Model, views: Sequence[tuple[int, Tensor | None]], stage: Stage) -> None:
        self.wait()
        sizes = len(model.splats), model.moving
        news = None if sizes == self._told else sizes
        self._told = sizes
        rows, weights = zip(*views, strict=True)
        task = _Task(
            news, _sent(stage.teachers), stage.progress, stage.moving, rows,
            [_sent(own) for own in weights],
        )  # fmt: skip
        try:
            self.pipe.send(task)
        except OSError as error:
            raise self._has_ended() from error

    def receive(self) -> list[_Answer]:
        try:
            answer = self.pipe.recv()
        except (EOFError, OSError) as error:
            raise self._has_ended() from error
        if isinstance(answer, Exception):
            raise answer
        answers: list[_Answer] = answer
        return answers

    def looks(self, model: Model) -> list[Look]:
        """Wait for the answers to the last task."""
        shapes = {name: tensor.shape for name, tensor in model.tensors().items()}
        looks = []
        for answer, shelf in zip(self.receive(), self.answers, strict=False):
            gradients = [
                shelf.tensor(name, shape) if there else None
                for there, (name, shape) in zip(answer.there, shapes.items(), strict=True)
            ]
            on_screen = shelf.tensor(_ON_SCREEN, (len(model.splats), 2))
            errors = _received(answer.errors)
            looks.append(Look(torch.tensor(answer.loss), gradients, on_screen, answer.size, errors))
        return looks

    def end(self) -> None:
        self.pipe.close()
        self.process.join(timeout=5)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()

    def _has_ended(self) -> GsdmsrError:
        self.process.join(timeout=1)
        return GsdmsrError(
            f"a helper process of the training has ended (exit code {self.process.exitcode}); "
            "the last checkpoint is kept; --threads 1 trains without helpers"
        )


class _Desk:
    """What a helper works with.

    Attributes:
        published: the model's tensors, from the training.
        answers: a place for the gradients of each look of a task.
    """

    def __init__(
        self,
        observer: Observer,
        views: Sequence[View],
        model: Model,
        published: _Shelf,
        answers: Sequence[_Shelf],
    ) -> None:
        self.published, self.answers = published, answers
        self._observer, self._views, self._model = observer, views, model

    def do(self, task: _Task) -> list[_Answer]:
        """Look at the task's views."""
        model = self._model
        if task.sizes is not None:
            model.become(*task.sizes)
            self.published.lend(model)
        model.motion.advance(task.progress)
        stage = Stage(task.progress, task.moving, _received(task.teachers))
        answers = []
        for row, sent, shelf in zip(task.views, task.tile_weights, self.answers, strict=False):
            (look,) = self._observer.look(model, [self._views[row]], stage, [_received(sent)])
            answers.append(self._answer(look, shelf))
        return answers

    def _answer(self, look: Look, shelf: _Shelf) -> _Answer:
        gradients = dict(zip(self._model.tensors(), look.gradients, strict=True))
        gradients[_ON_SCREEN] = look.on_screen
        shelf.write({name: tensor for name, tensor in gradients.items() if tensor is not None})
        there = [tensor is not None for tensor in look.gradients]
        return _Answer(look.loss.item(), there, look.size, _sent(look.errors))


def _sent(tensor: Tensor | None) -> NDArray[Any] | None:
    """Return what goes through a pipe; torch would put a tensor into a file of shared memory."""
    return None if tensor is None else tensor.numpy()


def _received(array: NDArray[Any] | None) -> Tensor | None:
    return None if array is None else torch.from_numpy(array)


def _serve(
    pipe: Connection,
    foreign: Sequence[Connection],
    desk: _Desk,
    prepare: Callable[[], object],
) -> None:
    """Be a helper: do one task after another until the training closes the pipe or ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training to deal with
    torch.set_num_threads(1)  # torch's own threads have not come along
    for other in foreign:
        other.close()
    with contextlib.suppress(EOFError, OSError):
        try:
            prepare()
            pipe.send([])
            while True:
                pipe.send(desk.do(pipe.recv()))
        except GsdmsrError as error:
            pipe.send(error)
        except (EOFError, OSError):
            raise
        except Exception:
            pipe.send(RuntimeError(traceback.format_exc()))


class _Shelf:
    """Shared memory with a place for each tensor of a model, whatever its number of splats."""

    def __init__(self, model: Model, capacity: int, on_screen: bool = False) -> None:
        by_splat = {*STORED, *model.held_by_motion()}
        most = {
            name: math.prod(t.shape[1:]) * capacity if name in by_splat else t.numel()
            for name, t in model.tensors().items()
        }
        if on_screen:
            most[_ON_SCREEN] = 2 * capacity
        self._starts, total = {}, 0
        for name, size in most.items():
            self._starts[name] = total
            total += size
        # anonymous: it goes with the last process that holds it, and takes only what is written
        self._memory = torch.frombuffer(mmap.mmap(-1, 4 * total), dtype=torch.float32)

    def tensor(self, name: str, shape: Sequence[int]) -> Tensor:
        """Return the place of the named tensor."""
        start = self._starts[name]
        return self._memory[start : start + math.prod(shape)].view(*shape)

    def hold(self, model: Model) -> None:
        """Move the model's tensors to their places, if they are elsewhere."""
        for name, tensor in model.tensors().items():
            place = self.tensor(name, tensor.shape)
            if tensor.data_ptr() != place.data_ptr():
                place.copy_(tensor.detach())
                tensor.data = place

    def lend(self, model: Model) -> None:
        """Let the model's tensors be those that lie here."""
        for name, tensor in model.tensors().items():
            tensor.data = self.tensor(name, tensor.shape)

    @torch.no_grad()
    def write(self, tensors: Mapping[str, Tensor]) -> None:
        """Copy the tensors to their places."""
        for name, tensor in tensors.items():
            self.tensor(name, tensor.shape).copy_(tensor)
