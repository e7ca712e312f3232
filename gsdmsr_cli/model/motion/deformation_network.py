"""A network says of every place and time how far what is there moves, turns and grows.

Deformable-3DGS (Yang et al., CVPR 2024): the canonical position and the time go through positional
encodings and a network with a skip to offsets of position, rotation and scale (section 3.2). In
training the time is noisy at first, which makes the motion smooth in between the moments that were
seen (annealing smooth training, section 3.3).

The paper's network has 8 layers of 256 columns. On a CPU those take nine times what the default of
64 takes. A time is encoded as in the paper's real scenes, without the small network that synthetic
ones have there, and positions are in units of the bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.limits import require_multiples
from gsdmsr_cli.model.motion._encoded_network import MOST_OCTAVES, Shape, new_encoded_network
from gsdmsr_cli.ops.displace import PARTS
from gsdmsr_cli.options.strict import require, require_progress

LEAST_GROWTH = 1e-3
"""What an offset of a scale leaves of it at least: a scale of 0 has no logarithm."""

LEAST_LOG_SCALE = -30.0
"""Offsets of smaller scales count as those of such a one, whose inverse is a number."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        width: width of the hidden layers, a multiple of 16; 256 in the paper.
        depth: number of hidden layers, 2 to 16; 8 in the paper.
        position_octaves, time_octaves: frequencies of the encodings, 0 to 16.
        noise: standard deviation of the noise of the time at the start, in units of the time
            between two frames (the paper's beta); 0 is off.
        noise_until: progress at which the noise, which falls linearly, has ended.
    """

    width: int = 64
    depth: int = 8
    position_octaves: int = 10
    time_octaves: int = 6
    noise: float = 0.1
    noise_until: float = 0.5

    def __post_init__(self) -> None:
        require_multiples(self, "width")
        require(self, "depth", 2 <= self.depth <= 16, "2 to 16")
        for key in ("position_octaves", "time_octaves"):
            within = 0 <= getattr(self, key) <= MOST_OCTAVES
            require(self, key, within, f"0 to {MOST_OCTAVES}")
        require(self, "noise", self.noise >= 0, "0 or more")
        require_progress(self, "noise_until")


class DeformationNetwork(Layer):
    """x + dx, q / |q| + dq and s + ds, with the offsets read at x, which gets no gradient by that.

    Attributes:
        noise: standard deviation of the time in this phase of the training.
    """

    needs_jitter = True

    def __init__(self, options: Options, facts: Facts, generator: torch.Generator) -> None:
        self.options, self.facts, self.noise = options, facts, 0.0
        sizes = options.width, options.depth, options.position_octaves, options.time_octaves
        self.network = new_encoded_network(Shape(*sizes), generator)
        super().__init__(self.network.parameters("network"))

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the deformed splats."""
        return self.at_instants(moment, [instant])[0]

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return the deformed splats at several times; their places are encoded once."""
        points = moment.splats.means.detach() / self.facts.bound
        times = [one.time + self.noise * one.jitter for one in instants]
        found = self.network.apply(points, times)
        return [replace(moment, splats=deform(moment.splats, offsets)) for offsets in found]

    def advance(self, progress: float) -> None:
        """Let the noise of the time fall: beta dt max(0, 1 - k / tau) of section 3.3."""
        o = self.options
        left = max(0.0, 1 - progress / o.noise_until) if o.noise_until > 0 else 0.0
        self.noise = o.noise * left / max(self.facts.frames, 1)

    def check(self) -> None:
        """Raise ValueError unless the layers of the network fit together."""
        self.network.check()


def deform(splats: Splats, offsets: Tensor) -> Splats:
    """Return splats with offsets (N, 10) of means, unit quaternions and scales (equation 5).

    Offsets are added after activation: not to logarithms of scales but to scales. Engines read
    these squared, so one that would be negative is as good as its absolute value.
    """
    shift, turn, growth = offsets.split(PARTS, dim=1)
    lengths = splats.quats.norm(dim=1, keepdim=True)
    factors = 1 + growth * (-splats.log_scales.clamp(min=LEAST_LOG_SCALE)).exp()
    return replace(
        splats,
        means=splats.means + shift,
        quats=splats.quats + lengths * turn,
        log_scales=splats.log_scales + factors.abs().clamp(min=LEAST_GROWTH).log(),
    )


def start(
    options: Options, facts: Facts, splats: Splats, generator: torch.Generator
) -> DeformationNetwork:
    """Return a motion that is the identity until its network's last layer has been trained."""
    return DeformationNetwork(options, facts, generator)
