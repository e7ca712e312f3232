"""What motions share that are learnt moment after moment (``training.streaming``)."""

from __future__ import annotations

from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.motion._arcs import added_to_none, slerp, turned
from gsdmsr_cli.model.parameter import Parameter, Rate


class Knot(NamedTuple):
    """Where R rows are at one moment.

    Attributes:
        offsets: (R, 3) from where they are at the first moment [scene bounds].
        turns: (R, 4), what is added to the quaternion of no rotation.
    """

    offsets: Tensor
    turns: Tensor


class Streamed(Layer):
    """Offsets and turns of R rows at K + 2 moments that ascend; at the first they are 0.

    A subclass says what the rows are, and what they make of splats. Between two moments splats go
    straight, and turn on arcs.

    Args:
        facts: of the scene.
        rows: R, to begin with.
        per_splat: whether they are the splats.
        rows_per_splat: see ``Parameter``, where they are not.
        rates: learning rates of offsets and turns; None where a moment learns something else.
        own: further parameters.

    Attributes:
        learnt: names of the parameters that a moment after the first learns.
        staying: names of those that the first moment settles for all.
        bound: of the scene [world units].
        offsets, turns: of the newest moment.
        past_offsets, past_turns: (R, K, 3) and (R, K, 4), of those in between; while a stream is
            trained the last before the newest alone.
        times: (K + 2,) float64 in [0, 1], of all moments.
    """

    learnt: Sequence[str] = ("offsets", "turns")
    staying: ClassVar[Sequence[str]] = ()

    def __init__(
        self,
        facts: Facts,
        rows: int,
        per_splat: bool,
        rates: tuple[Rate | None, Rate | None],
        own: Sequence[Parameter] = (),
        rows_per_splat: int = 0,
    ) -> None:
        self.bound = facts.bound
        self.offsets, self.turns = torch.zeros(rows, 3), torch.zeros(rows, 4)
        self.past_offsets, self.past_turns = torch.zeros(rows, 1, 3), torch.zeros(rows, 1, 4)
        self.times = torch.linspace(0, 1, 3, dtype=torch.float64)
        rows_of = {
            "offsets": (self.offsets, rates[0]),
            "turns": (self.turns, rates[1]),
            "past_offsets": (self.past_offsets, None),
            "past_turns": (self.past_turns, None),
        }
        held = [
            Parameter(name, tensor, per_splat, rate, rows_per_splat=rows_per_splat)
            for name, (tensor, rate) in rows_of.items()
        ]
        super().__init__([*held, Parameter("times", self.times), *own])

    @abstractmethod
    def of_splats(self, means: Tensor, index: int) -> Knot:
        """Return where splats that begin at ``means`` (N, 3) are at a moment after the first.

        ``index`` counts moments from 0; ``knot`` has the rows of each.
        """

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved and turned splats; after the newest moment they stay where they are."""
        times, means = self.times.tolist(), moment.splats.means
        after = bisect_right(times, instant.time)
        if after == 0:
            return moment
        (offsets, turns), turn = self._known(means, after - 1), None
        if after < len(times) and instant.time > times[after - 1]:
            u = (instant.time - times[after - 1]) / (times[after] - times[after - 1])
            next_offsets, next_turns = self._known(means, after)
            offsets, turn = torch.lerp(offsets, next_offsets, u), slerp(turns, next_turns, u)
        turn = turned(turns) if turn is None else turn
        splats = replace(
            moment.splats,
            means=means + self.bound * offsets,
            quats=quat_product(turn, moment.splats.quats),
        )
        return replace(moment, splats=splats)

    def _known(self, means: Tensor, index: int) -> Knot:
        if index == 0:
            return Knot(torch.zeros_like(means), means.new_zeros(len(means), 4))
        return self.of_splats(means, index)

    def is_newest(self, index: int) -> bool:
        """Return whether a moment is the newest, which is learnt or has been last."""
        return index == len(self.times) - 1

    def knot(self, index: int) -> Knot:
        """Return the rows of a moment after the first."""
        if self.is_newest(index):
            return Knot(self.offsets, self.turns)
        return Knot(self.past_offsets[:, index - 1], self.past_turns[:, index - 1])

    @torch.no_grad()
    def go_on(self, first: float, last: float, time: float, share: float) -> None:
        """Let the newest moment become the last one, and begin another as if it went on so.

        Luiten et al. 2024, section 3.4: what has moved goes on at the same velocity.

        Args:
            first: time of the first moment of all.
            last: time of the newest so far, which ``offsets`` and ``turns`` are of.
            time: of the one that begins.
            share: of the velocity that is taken over, 0 to 1.
        """
        before = float(self.times[1])
        u = share * (time - last) / (last - before) if last > before else 0.0
        for new, past in ((self.offsets, self.past_offsets), (self.turns, self.past_turns)):
            going = new + u * (new - past[:, 0])
            past[:, 0] = new
            new.copy_(going)
        self.times.copy_(torch.tensor([first, last, time], dtype=torch.float64))

    @torch.no_grad()
    def settle(self, splats: Splats, first: bool) -> None:
        """Let ``offsets`` and ``turns`` say all of the newest moment, turns of unit quaternions.

        Called once as a moment ends.

        Args:
            splats: those that move, as they are at the first moment.
            first: whether that is the one that ends; from then on there are always the same splats.
        """
        self.turns.copy_(added_to_none(turned(self.turns)))

    @torch.no_grad()
    def mend(self) -> Mapping[str, Tensor]:
        """Take rows that are not finite back to where the last moment left them.

        They must not be dropped: every moment's file has the same rows.

        Returns:
            which rows of which parameters, by name, (R,) bool.
        """
        found = {}
        for name in ("offsets", "turns"):
            new, past = getattr(self, name), getattr(self, f"past_{name}")
            lost = ~new.isfinite().all(dim=1)
            if lost.any():
                new[lost] = past[lost, 0]
                found[name] = lost
        return found

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """See ``Layer.restore``; there may be any number of moments."""
        for parameter in self.parameters():
            saved = tensors.get(parameter.name)
            if parameter.name.startswith("past_") and saved is not None and saved.dim() == 3:
                rows = count if parameter.per_splat else len(saved)
                width = parameter.tensor.shape[2]
                parameter.set_values(parameter.tensor.new_zeros(rows, saved.shape[1], width))
        super().restore(tensors, count)

    def check(self) -> None:
        """Raise ValueError unless there is a time for every moment, and times ascend."""
        moments, rows = self.past_offsets.shape[1], len(self.offsets)
        if self.past_turns.shape[1] != moments or len(self.times) != moments + 2:
            raise ValueError(
                f"tracks of {moments} and {self.past_turns.shape[1]} moments between the first and "
                f"the last, and {len(self.times)} times"
            )
        counts = [len(own) for own in (self.turns, self.past_offsets, self.past_turns)]
        if counts != [rows] * 3:
            raise ValueError(f"tracks of {rows} and of {counts} rows")
        if not (self.times[1:] >= self.times[:-1]).all():
            raise ValueError("times of tracks that do not ascend")
