"""Every splat goes through keyframes of its own: cubic between positions, arcs between rotations.

Ex4DGS (Lee et al., NeurIPS 2024), its dynamic splats: positions are cubic Hermite curves whose
tangents are half of the difference between the keyframe after and the one before; rotations are
interpolated spherically (slerp) between neighbouring keyframes.

Here keyframes hold how far a splat is from where it is stored, and how it is turned from there, so
that a splat whose keyframes are 0 goes nowhere: the layers after this one, such as ``drift``, move
it all the same, and a splat that is made dynamic is at first drawn as before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.motion._arcs import slerp
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.options.strict import require, require_rates


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        keyframes: their number from time 0 to time 1, 2 or more; null is one for each ``interval``.
        interval: distinct train times from one keyframe to the next, 1 or more.
        rate: learning rate of the positions at the start and the end [scene bounds].
        turn_rate: that of the rotations.
        nearness: weight of the mean distance of keyframes from the first [scene bounds].
    """

    keyframes: int | None = None
    interval: int = 10
    rate: tuple[float, float] = (2e-3, 4e-5)
    turn_rate: tuple[float, float] = (1e-3, 1e-4)
    nearness: float = 1e-4

    def __post_init__(self) -> None:
        known = self.keyframes is None or self.keyframes >= 2
        require(self, "keyframes", known, "null or 2 or more")
        require(self, "interval", self.interval >= 1, "1 or more")
        require(self, "nearness", self.nearness >= 0, "0 or more")
        require_rates(self, "rate", "turn_rate")

    def count(self, frames: int) -> int:
        """Return the number of keyframes of a capture of so many distinct times."""
        return self.keyframes or max(-(-(frames - 1) // self.interval) + 1, 2)


class KeyframeMotion(Layer):
    """Offsets (N, K + 2, 3) in units of the bound and turns (N, K, 4), of K keyframes.

    There is an offset before time 0 and one after time 1, for the tangents at both ends.
    """

    def __init__(self, options: Options, facts: Facts, count: int) -> None:
        self.options, self.bound = options, facts.bound
        keyframes = options.count(facts.frames)
        self.offsets = torch.zeros(count, keyframes + 2, 3)
        self.turns = torch.zeros(count, keyframes, 4)
        super().__init__(
            [
                Parameter("offsets", self.offsets, per_splat=True, rate=options.rate),
                Parameter("turns", self.turns, per_splat=True, rate=options.turn_rate),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved and turned splats."""
        intervals = self.turns.shape[1] - 1
        place = min(max(instant.time, 0.0), 1.0) * intervals
        before = min(int(place), intervals - 1)
        weights = hermite(place - before)
        turn = slerp(self.turns[:, before], self.turns[:, before + 1], place - before)
        splats = replace(
            moment.splats,
            means=add_series(moment.splats.means, self.offsets, weights, self.bound, before),
            quats=quat_product(turn, moment.splats.quats),
        )
        return replace(moment, splats=splats)

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        """Prefer keyframes near the first."""
        apart: Tensor = (self.offsets[:, 1:] - self.offsets[:, :1]).norm(dim=2)
        return self.options.nearness * apart.mean()


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Layer:
    """Return a motion that is the identity until it has been trained."""
    return KeyframeMotion(options, facts, len(splats))


def hermite(u: float) -> tuple[float, float, float, float]:
    """Return the weights of four keyframes at u in [0, 1] between the second and the third.

    The curve a y_1 + b m_1 + c y_2 + d m_2 of Hermite's polynomials a to d with the tangents
    m_k = (y_{k+1} - y_{k-1}) / 2.
    """
    b, d = u**3 - 2 * u**2 + u, u**3 - u**2
    c = 3 * u**2 - 2 * u**3
    return -b / 2, 1 - c - d / 2, c + b / 2, d / 2
