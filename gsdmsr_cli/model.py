"""A trained scene: canonical splats, and the motion of those that move."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.errors import DataError
from gsdmsr_cli.motion import Facts, Motion, start_motion
from gsdmsr_cli.splats import NAMES, Splats

STORED_AS = "splats."
MOVED_BY = "motion."
STORED = tuple(STORED_AS + name for name in NAMES)
"""Names of the splats' own tensors, which have a row for each splat."""
STILL = "motion.still"
"""Under which name ``Model.still`` is saved."""


class Model:
    """N canonical splats and the motion of those that move; mutable, since training changes both.

    Attributes:
        splats: all of them.
        motion: holds and moves those that move, in their order.
        still: (N,) bool, those that stay where they are at all times, and cost no motion.
    """

    def __init__(self, splats: Splats, motion: Motion, still: Tensor | None = None) -> None:
        self.splats = splats.map(lambda t: torch.nn.Parameter(t.detach().contiguous()))
        self.motion = motion
        self._let_rest(torch.zeros(len(splats), dtype=torch.bool) if still is None else still)

    def _let_rest(self, still: Tensor) -> None:
        self.still = still
        self._moving = (~still).nonzero().flatten()

    def at(self, time: float, teachers: Tensor | None = None) -> Splats:
        """Return the splats at ``time`` in [0, 1].

        Args:
            teachers: (N,) bool, the splats whose gradients the motion is to learn from; all if
                None. The others pass theirs to their canonical values alone, as if what the motion
                adds to them were constant.
        """
        if len(self._moving) == len(self.splats):
            return self._move(self.splats, time, teachers)
        if not len(self._moving):
            return self.splats
        before = self.splats.take(self._moving)
        own = None if teachers is None else teachers[self._moving]
        after = self._move(before, time, own).tensors()
        moved = {
            name: getattr(self.splats, name).index_copy(0, self._moving, after[name])
            for name, tensor in before.tensors().items()
            if after[name] is not tensor  # what the motion leaves alone needs no copy
        }
        return replace(self.splats, **moved)

    def _move(self, splats: Splats, time: float, teachers: Tensor | None) -> Splats:
        moved = self.motion.at(splats, time)
        return moved if teachers is None else _spare(splats, moved, teachers)

    def penalty(self, time: float, generator: torch.Generator) -> Tensor | None:
        """Return the motion's regularisers, looked at for the splats that move at ``time``."""
        moving = len(self._moving)
        splats = self.splats if moving == len(self.splats) else self.splats.take(self._moving)
        return self.motion.penalty(splats, time, generator) if moving else None

    def take(self, rows: Tensor) -> Tensor:
        """Make row i what row ``rows[i]`` was; rows is (M,) int64.

        The one resize verb: clone, split, prune and reorder. For every motion
        ``take`` then ``at`` equals ``at`` then ``take``.

        Returns:
            the rows that ``motion`` has taken; its own count only the splats that move.
        """
        places = (~self.still).cumsum(0) - 1
        still = self.still[rows]
        held = places[rows[~still]]
        self._resize(rows, held, still)
        return held

    def become(self, still: Tensor) -> None:
        """Take the shapes of a model with such a ``still``; all values must then be set anew."""
        rows = torch.zeros(len(still), dtype=torch.int64)
        self._resize(rows, rows[~still], still)

    def _resize(self, rows: Tensor, held: Tensor, still: Tensor) -> None:
        self.splats = self.splats.detach().take(rows).map(torch.nn.Parameter)
        self.motion.take(held)
        self._let_rest(still)

    @torch.no_grad()
    def settle(self, still: Tensor, where: Splats) -> Tensor:
        """Let further splats stand still.

        Args:
            still: (N,) bool, those that are to stand still; ones that do already may be named.
            where: N splats, whose values those take that begin to.

        Returns:
            the rows that ``motion`` has taken, as ``take`` does.
        """
        fresh = still & ~self.still
        for name, tensor in self.splats.tensors().items():
            tensor[fresh] = getattr(where, name)[fresh]
        held = (~still[self._moving]).nonzero().flatten()
        self.motion.take(held)
        self._let_rest(self.still | still)
        return held

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
    tensors: Mapping[str, Tensor], settings: Mapping[str, Any], facts: Facts, progress: float
) -> Model:
    """Rebuild a model from its saved tensors.

    Args:
        tensors: what ``Model.tensors`` returned, and ``STILL`` if any stand still, perhaps among
            others.
        settings: the motion's name and options.
        facts: the facts the motion was started with.
        progress: how far training had come.

    Raises:
        DataError: a tensor is missing or has another shape than the settings ask for.
    """
    stored = {k: v for k, v in tensors.items() if k.startswith(STORED_AS)}
    still = tensors.get(STILL)
    try:
        splats = Splats(**{name.removeprefix(STORED_AS): t for name, t in stored.items()})
    except (TypeError, ValueError) as error:
        raise DataError(f"the checkpoint's splats cannot be used: {error}") from error
    if still is not None and (still.dtype, len(still)) != (torch.bool, len(splats)):
        raise DataError(f"the checkpoint holds '{STILL}' of {len(still)} rows, not {len(splats)}")
    moving = len(splats) if still is None else len(splats) - int(still.sum())
    motion = start_motion(settings, facts, moving, torch.Generator())
    model = Model(splats, motion, still)
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
