"""A trained scene: canonical splats, and the motion of those that move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.errors import DataError
from gsdmsr_cli.fields.precision import computing_in
from gsdmsr_cli.motion import Facts, Motion, MovingAtOnce, Rooted, start_motion
from gsdmsr_cli.splats import NAMES, Splats

STORED_AS = "splats."
MOVED_BY = "motion."
STORED = tuple(STORED_AS + name for name in NAMES)
"""Names of the splats' own tensors, which have a row for each splat."""
MOVING = "motion.moving"
"""Under which name ``Model.moving`` is saved."""


class Model:
    """N canonical splats and the motion of those that move; mutable, since training changes both.

    Attributes:
        splats: all of them, those that move first: taking them apart then copies nothing.
        motion: holds and moves those that move.
        moving: how many do; the others stay where they are at all times, and cost no motion.
        precision: what the motion's fields compute in on a GPU, see ``fields.precision``.
    """

    def __init__(
        self,
        splats: Splats,
        motion: Motion,
        moving: int | None = None,
        precision: str = "float32",
    ) -> None:
        self.splats = splats.map(lambda t: torch.nn.Parameter(t.detach().contiguous()))
        self.motion = motion
        self.moving = len(splats) if moving is None else moving
        self.precision = precision

    def at(self, time: float, teachers: Tensor | None = None) -> Splats:
        """Return the splats at ``time`` in [0, 1], see ``at_times``."""
        return self.at_times([time], teachers)[0]

    def at_times(self, times: Sequence[float], teachers: Tensor | None = None) -> list[Splats]:
        """Return the splats at each of the times in [0, 1].

        Args:
            times: moved to in one go if the motion can.
            teachers: (N,) bool, the splats whose gradients the motion is to learn from; all if
                None. The others pass theirs to their canonical values alone, as if what the motion
                adds to them were constant.
        """
        if self.moving == len(self.splats):
            return self._move(self.splats, times, teachers)
        if not self.moving:
            return [self.splats] * len(times)
        sizes = [self.moving, len(self.splats) - self.moving]
        parts = {name: tensor.split(sizes) for name, tensor in self.splats.tensors().items()}
        before = Splats(**{name: first for name, (first, _) in parts.items()})
        own = None if teachers is None else teachers[: self.moving]
        moved = []
        for moment in self._move(before, times, own):
            after = moment.tensors()
            whole = {
                name: torch.cat([after[name], still])
                for name, (first, still) in parts.items()
                if after[name] is not first  # what the motion leaves alone needs no copy
            }
            moved.append(replace(self.splats, **whole))
        return moved

    def _move(
        self, splats: Splats, times: Sequence[float], teachers: Tensor | None
    ) -> list[Splats]:
        motion = self.motion
        with computing_in(self.precision):
            if len(times) > 1 and isinstance(motion, MovingAtOnce):
                moved = motion.at_times(splats, times)
            else:
                moved = [motion.at(splats, time) for time in times]
        return moved if teachers is None else [_spare(splats, one, teachers) for one in moved]

    def penalty(self, time: float, generator: torch.Generator) -> Tensor | None:
        """Return the motion's regularisers, looked at for the splats that move at ``time``."""
        splats = self.splats.map(lambda tensor: tensor[: self.moving])
        with computing_in(self.precision):
            return self.motion.penalty(splats, time, generator) if self.moving else None

    def take(self, rows: Tensor) -> None:
        """Make row i what row ``rows[i]`` was; rows is (M,) int64.

        The one resize verb: clone, split, prune and reorder. For every motion
        ``take`` then ``at`` equals ``at`` then ``take``. The motion takes the first ``moving``
        rows, as that is afterwards.

        Raises:
            ValueError: the row of a splat that moves comes after one of a splat that does not.
        """
        moves = rows < self.moving
        moving = int(moves.sum())
        if not moves[:moving].all():
            raise ValueError("rows of splats that move come after rows of splats that stand still")
        self._resize(rows, moving)

    @torch.no_grad()
    def root(self) -> list[str]:
        """Tie the motion to the splats that move now; return the names of what that has changed."""
        if not isinstance(self.motion, Rooted) or not self.moving:
            return []
        moving = self.splats.map(lambda tensor: tensor[: self.moving])
        return [MOVED_BY + name for name in self.motion.root(moving)]

    def become(self, count: int, moving: int) -> None:
        """Take the shapes of a model of so many splats; all values must then be set anew."""
        self._resize(torch.zeros(count, dtype=torch.int64), moving)

    def _resize(self, rows: Tensor, moving: int) -> None:
        self.splats = self.splats.detach().take(rows).map(torch.nn.Parameter)
        self.motion.take(rows[:moving])
        self.moving = moving

    @torch.no_grad()
    def settle(self, still: Tensor, where: Splats) -> Tensor:
        """Let further splats stand still, and put them behind those that move.

        Args:
            still: (N,) bool, those that are to stand still; ones that do already may be named.
            where: N splats, whose values those take that begin to.

        Returns:
            the row (N,) that each row was; the motion has taken the first ``moving`` of them.
        """
        fresh = still[: self.moving]
        for name, tensor in self.splats.tensors().items():
            tensor[: self.moving][fresh] = getattr(where, name)[: self.moving][fresh]
        settled = torch.arange(len(self.splats), device=still.device) >= self.moving
        settled[: self.moving] |= fresh
        order = settled.to(torch.uint8).argsort(stable=True)
        self._resize(order, len(order) - int(settled.sum()))
        return order

    def to(self, device: torch.device | str) -> Model:
        """Move everything to a device, in place, and return the model."""
        for tensor in self.tensors().values():
            if tensor.device != torch.device(device):
                torch.utils.swap_tensors(tensor, torch.nn.Parameter(tensor.detach().to(device)))
        return self

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that is trained and saved, by name."""
        named = {STORED_AS + name: tensor for name, tensor in self.splats.tensors().items()}
        return named | {MOVED_BY + name: t for name, t in self.motion.tensors().items()}

    def held_by_motion(self) -> list[str]:
        """Return the names of the motion's tensors with one row for each splat that moves."""
        groups, own = self.motion.groups(), ("embeddings", *NAMES)
        return [MOVED_BY + name for name, group in groups.items() if group in own]


def _spare(before: Splats, after: Splats, teachers: Tensor) -> Splats:
    """Return ``after``, whose gradients go through the motion in the rows ``teachers`` only."""
    spared = {
        name: _Spare.apply(tensor, getattr(after, name), teachers)
        for name, tensor in before.tensors().items()
        if getattr(after, name) is not tensor
    }
    return replace(after, **spared)


class _Spare(Function):
    @staticmethod
    def forward(ctx: Any, before: Tensor, after: Tensor, teachers: Tensor) -> Tensor:
        ctx.teachers = teachers.view(-1, *[1] * (after.dim() - 1))
        return after.view_as(after)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_after: Tensor) -> tuple[Tensor, Tensor, None]:
        taught = d_after * ctx.teachers
        return d_after - taught, taught, None


def load_model(
    tensors: Mapping[str, Tensor],
    settings: Mapping[str, Any],
    facts: Facts,
    progress: float,
    precision: str = "float32",
) -> Model:
    """Rebuild a model from its saved tensors.

    Args:
        tensors: what ``Model.tensors`` returned, and ``MOVING`` if not all move, perhaps among
            others.
        settings: the motion's name and options.
        facts: the facts the motion was started with.
        progress: how far training had come.
        precision: see ``Model``.

    Raises:
        DataError: a tensor is missing or has another shape than the settings ask for.
    """
    stored = {k: v for k, v in tensors.items() if k.startswith(STORED_AS)}
    try:
        splats = Splats(**{name.removeprefix(STORED_AS): t for name, t in stored.items()})
    except (TypeError, ValueError) as error:
        raise DataError(f"the checkpoint's splats cannot be used: {error}") from error
    moving = int(tensors[MOVING]) if MOVING in tensors else len(splats)
    if not 0 <= moving <= len(splats):
        raise DataError(f"the checkpoint says that {moving} of {len(splats)} splats move")
    motion = start_motion(settings, facts, moving, torch.Generator())
    model = Model(splats, motion, moving, precision)
    model.motion.advance(progress)
    with torch.no_grad():
        for name, tensor in model.motion.tensors().items():
            saved = tensors.get(MOVED_BY + name)
            if saved is None or saved.shape != tensor.shape:
                found = "nothing" if saved is None else f"shape {tuple(saved.shape)}"
                raise DataError(
                    f"the checkpoint holds {found} for '{name}', not {tuple(tensor.shape)}"
                )
            tensor.copy_(saved)
    return model
