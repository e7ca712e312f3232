"""Resizes a model in training, and everything that is kept for each of its splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.model.model import STORED, Model
from gsdmsr_cli.ops.finite import all_finite, finite_rows
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.averaging import Average
from gsdmsr_cli.training.optimizer import Adam
from gsdmsr_cli.training.saliency import Saliency
from gsdmsr_cli.training.statistics import DensityStatistics

SPLIT_SHRINK = 1.6
"""A split splat's children are this much smaller (3DGS: 0.8 times the two children)."""

MOST_LOST = 0.5
"""Share of the splats that may be dropped at a time for values that are not finite."""


@dataclass(frozen=True, eq=False)
class Resize:
    """Which splats there are to be.

    Attributes:
        rows: (M,) int64, the row that each of the new rows was.
        fresh: (M,) bool, rows that are clones or children: they begin without momentum.
        splats: M splats, the values that the rows begin with; those of their parents if None.
        still: (M,) bool, rows that stand still from now on; those whose parents do, if None.
        split: (M,) bool, rows that are children of a split, which layers tell apart as well.
        moving: (M,) bool, rows that move from now on, though their parents have stood still; none
            if None.
    """

    rows: Tensor
    fresh: Tensor
    splats: Splats | None = None
    still: Tensor | None = None
    split: Tensor | None = None
    moving: Tensor | None = None


def kept(rows: Tensor) -> Resize:
    """Return the resize that leaves only these rows (M,) int64, in this order."""
    return Resize(rows, torch.zeros_like(rows, dtype=torch.bool))


@torch.no_grad()
def resize_model(
    model: Model, change: Resize, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Let a model have other splats; return rows and fresh (M,) in the order that they now have.

    The model wants rows that move before those that stand still; of either kind they stay in the
    order given. ``generator`` is the source of what tells the children of splits apart.
    """
    rows, fresh = change.rows, change.fresh
    still = rows >= model.moving
    if change.still is not None:
        still |= change.still
    if change.moving is not None:
        still &= ~change.moving
    order = still.to(torch.uint8).argsort(stable=True)
    rows, fresh = rows[order], fresh[order]
    model.take_moving(rows, fresh, len(rows) - int(still.sum()))
    if change.splats is not None:
        for name, tensor in model.splats.tensors().items():
            tensor.copy_(getattr(change.splats, name)[order])
    if change.split is not None and generator is not None:
        model.scatter(change.split[order], SPLIT_SHRINK, generator)
    return rows, fresh


class Population:
    """A model in training, and what is kept beside it for each of its splats.

    Attributes:
        model: splats and layers.
        optimizer: with moments of every trained tensor.
        statistics: what density control goes by.
        saliency: which splats the optimiser updates in full.
        average: of the values so far.
        radius: of the scene [world units].
        cap: most splats there may be.
        generator: source of random choices.
        engine, background: what draws, and the (3,) colour behind the splats.
        shots: returns up to so many cameras of train views and their times, chosen at random.
        marked: returns up to so many cameras of train views that may be seen by now and have a mask
            of what moves, their times, and those masks (H, W) bool, chosen at random.
        all_threads: a context in which kernels may use every thread.
        moving: whether the static phase is over.
        dropped: how many splats have been dropped because their values were not finite.
    """

    def __init__(
        self,
        model: Model,
        optimizer: Adam,
        saliency: Saliency,
        radius: float,
        cap: int,
        generator: torch.Generator,
        engine: Engine,
        background: Tensor,
        shots: Callable[[int], Sequence[tuple[Camera, float]]],
        marked: Callable[[int], Sequence[tuple[Camera, float, Tensor]]],
        all_threads: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self.model, self.optimizer, self.saliency = model, optimizer, saliency
        self.radius, self.cap, self.generator = radius, cap, generator
        self.engine, self.background, self.shots = engine, background, shots
        self.marked, self.all_threads = marked, all_threads
        self.statistics = DensityStatistics(len(model.splats), model.splats.means.device)
        self.average = Average()
        self.moving = False
        self.dropped = 0

    def resize(self, change: Resize) -> None:
        """Let there be other splats, in the model and in everything that has rows of them.

        Raises:
            GsdmsrError: they would be more than the cap allows.
        """
        count = len(change.rows)
        if count > max(self.cap, len(self.model.splats)):
            raise GsdmsrError(f"{count} splats are more than density.cap, {self.cap}; raise it")
        held = self.model.moving
        rows, fresh = resize_model(self.model, change, self.generator)
        if (rows[: self.model.moving] >= held).any():  # what has begun to move has no average
            self.average.clear()
        for parameter in self.model.parameters():
            if parameter.per_splat:
                count = len(parameter.tensor)  # of those that move alone, for some
                self.optimizer.take(parameter.name, rows[:count], fresh[:count])
                self.average.take(parameter.name, rows[:count])
        self.statistics.take(rows)
        self.saliency.take(rows, fresh)
        if fresh.any():
            self.average.clear()
            self.reanchor()

    def begin_moving(self) -> None:
        """Start the motion, without the momentum of what did not move."""
        self.moving = True
        for name in STORED:
            self.optimizer.reset_moments(name, second=False)
        self.reanchor()

    def reanchor(self) -> None:
        """Let layers that depend on where the splats are adapt to the present ones."""
        if self.moving:
            for name in self.model.reanchor():
                self.optimizer.reset_moments(name)

    def drop_not_finite(self) -> None:
        """Drop the splats of which a value is not finite, before they reach a layer.

        Raises:
            GsdmsrError: that is most of the splats.
        """
        tensors = [p.tensor.detach() for p in self.model.parameters() if p.per_splat]
        if all_finite(tensors):
            return
        finite = finite_rows(tensors, len(self.model.splats))
        lost = len(finite) - int(finite.sum())
        self.dropped += lost
        if lost > MOST_LOST * len(finite):
            raise GsdmsrError(
                f"{lost} of {len(finite)} splats have values that are not finite: the training "
                "has diverged; the last checkpoint is kept; lower the learning rates with "
                "--set optimizer..."
            )
        self.resize(kept(finite.nonzero().flatten()))
