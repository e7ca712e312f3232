"""Every splat has a place and a rotation of its own at each moment of the capture.

Dynamic 3D Gaussians (Luiten et al., 3DV 2024): the same splats all along, with constant colours,
opacities and sizes, each with a track of its own. Moments are trained one after the other, each
from the one before (``training.streaming``): what is trained is that of the newest alone. Between
two moments splats go straight, and turn on arcs.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.motion._arcs import slerp, turned
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.strict import require_rates

_PAST = "past_offsets", "past_turns"


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        rate: learning rate of the places at the start and the end of a moment [scene bounds].
        turn_rate: that of the rotations.
    """

    rate: tuple[float, float] = (3e-3, 1e-4)
    turn_rate: tuple[float, float] = (1e-2, 5e-4)

    def __post_init__(self) -> None:
        require_rates(self, "rate", "turn_rate")


class Tracks(Layer):
    """Where splats are, and how they are turned, at K + 2 moments that ascend.

    At the first they are as they are stored. Offsets are in units of the bound, turns what is added
    to the quaternion of no rotation.

    Attributes:
        offsets, turns: (N, 3) and (N, 4), at the newest moment: these are trained.
        past_offsets, past_turns: (N, K, 3) and (N, K, 4), at those in between; while it is trained
            the last before the newest alone.
        times: (K + 2,) float64 in [0, 1], of all moments.
    """

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.bound = facts.bound
        self.offsets, self.turns = torch.zeros(count, 3), torch.zeros(count, 4)
        self.past_offsets, self.past_turns = torch.zeros(count, 1, 3), torch.zeros(count, 1, 4)
        self.times = torch.linspace(0, 1, 3, dtype=torch.float64)
        super().__init__(
            [
                Parameter("offsets", self.offsets, per_splat=True, rate=options.rate),
                Parameter("turns", self.turns, per_splat=True, rate=options.turn_rate),
                Parameter("past_offsets", self.past_offsets, per_splat=True),
                Parameter("past_turns", self.past_turns, per_splat=True),
                Parameter("times", self.times),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved and turned splats; after the newest moment they stay where they are."""
        times = self.times.tolist()
        after = bisect_right(times, instant.time)
        if after == 0:
            return moment
        (offsets, turns), turn = self._knot(after - 1), None
        if after < len(times) and instant.time > times[after - 1]:
            u = (instant.time - times[after - 1]) / (times[after] - times[after - 1])
            next_offsets, next_turns = self._knot(after)
            offsets, turn = torch.lerp(offsets, next_offsets, u), slerp(turns, next_turns, u)
        turn = turned(turns) if turn is None else turn
        splats = replace(
            moment.splats,
            means=moment.splats.means + self.bound * offsets,
            quats=quat_product(turn, moment.splats.quats),
        )
        return replace(moment, splats=splats)

    def _knot(self, index: int) -> tuple[Tensor, Tensor]:
        """Return offsets (N, 3) and turns (N, 4) of one of the moments."""
        if index == 0:
            return torch.zeros_like(self.offsets), torch.zeros_like(self.turns)
        if index == len(self.times) - 1:
            return self.offsets, self.turns
        return self.past_offsets[:, index - 1], self.past_turns[:, index - 1]

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
    def settle(self) -> None:
        """Let the turns of the newest moment be those of unit quaternions."""
        self.turns.copy_(turned(self.turns) - self.turns.new_tensor([1.0, 0.0, 0.0, 0.0]))

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """See ``Layer.restore``; there may be any number of moments."""
        for parameter in self.parameters():
            saved = tensors.get(parameter.name)
            if parameter.name in _PAST and saved is not None and saved.dim() == 3:
                width = parameter.tensor.shape[2]
                parameter.set_values(parameter.tensor.new_zeros(count, saved.shape[1], width))
        super().restore(tensors, count)

    def check(self) -> None:
        """Raise ValueError unless there is a time for every moment, and times ascend."""
        moments = self.past_offsets.shape[1]
        if self.past_turns.shape[1] != moments or len(self.times) != moments + 2:
            raise ValueError(
                f"tracks of {moments} and {self.past_turns.shape[1]} moments between the first and "
                f"the last, and {len(self.times)} times"
            )
        if not (self.times[1:] >= self.times[:-1]).all():
            raise ValueError("times of tracks that do not ascend")


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Tracks:
    """Return a motion that is the identity until it has been trained."""
    return Tracks(options, facts, len(splats))
