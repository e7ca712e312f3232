"""Every splat goes where a short Fourier series of its own says, and turns at a constant rate.

Katsumata, Vo, Nakayama (ECCV 2024, section 3.1): the position is a series of the time whose
frequencies, as in its code, are octaves; the quaternion is linear in time and normalised where it
is used; scale, opacity and colour do not change. So a splat holds 3 (1 + 2 L) + 8 numbers for its
motion, however many moments there are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.options.strict import require

MOST = 8
"""Octaves beyond it go round more often than any capture has moments."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        octaves: number of frequencies of the series (the paper's L), 1 to 8; each is twice the one
            before it, and the first goes half way round in the whole capture.
    """

    octaves: int = 2

    def __post_init__(self) -> None:
        require(self, "octaves", 1 <= self.octaves <= MOST, f"1 to {MOST}")


class Fourier(Layer):
    """x(t) = w_0 + sum_i w_2i-1 sin(2^(i-1) pi t) + w_2i cos(2^(i-1) pi t), q(t) = q_0 + q_1 t.

    w_0 and q_0 are the canonical mean and quaternion; all positions follow one learning rate.
    """

    def __init__(self, options: Options, count: int) -> None:
        self.waves = torch.zeros(count, 2 * options.octaves, 3)
        self.turns = torch.zeros(count, 4)
        super().__init__(
            [
                Parameter("waves", self.waves, per_splat=True, rate="means"),
                Parameter("turns", self.turns, per_splat=True, rate="quats"),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moved and turned splats."""
        splats = moment.splats
        means = add_series(splats.means, self.waves, self._basis(instant.time))
        quats = splats.quats + instant.time * self.turns
        return replace(moment, splats=replace(splats, means=means, quats=quats))

    def _basis(self, time: float) -> list[float]:
        """Return sine and cosine of every frequency in turn, 2 L numbers."""
        phases = [2.0**i * math.pi * time for i in range(self.waves.shape[1] // 2)]
        return [wave(p) for p in phases for wave in (math.sin, math.cos)]

    def check(self) -> None:
        """Raise ValueError unless the waves are pairs of three coordinates, and turns of four."""
        waves, turns = tuple(self.waves.shape[1:]), tuple(self.turns.shape[1:])
        if len(waves) != 2 or waves[0] % 2 or waves[1] != 3 or turns != (4,):
            raise ValueError(f"waves of shape {waves} and turns of shape {turns} for each splat")


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Fourier:
    """Return a motion that is the identity until it has been trained."""
    return Fourier(options, len(splats))
