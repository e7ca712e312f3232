"""Splats for what is new at a moment of a stream, which those of the first moment cannot show.

The second stage of 3DGStream (Sun et al., CVPR 2024, section 3.3) spawns splats near those at which
the loss pulls, and drops them as the moment ends. Here there is a fixed number of them, which stay
from moment to moment: at each all that they are is learnt, and those that have faded are placed
where the errors of several cameras meet (``training.streaming.noticing``). So what has come in is
not looked for again, and every moment's file has the same rows.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import NAMES, Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.finite import finite_rows
from gsdmsr_cli.options.strict import require, require_rates

STREAMED = True
"""It is learnt moment after moment."""

FADED = 0.05
"""Newcomers less opaque than this are placed anew."""

BEGIN = 0.3
"""Opacity that they are placed with."""

_HIDDEN, _SMALL = -20.0, -10.0
"""Logit of the opacity, and logarithms of the scales, of what is not there."""

PAST, READY, TIMES = "past_", "ready", "times"

OWN = "layers.newcomers."
"""Before the names of the layer's tensors in a model."""

OF_ALL_MOMENTS = frozenset(OWN + name for name in (TIMES, *(PAST + name for name in NAMES)))
"""What is put together of all moments' files; the others are of one moment, or of the model."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        count: how many newcomers there are, 1 or more.
        noticed: error of colours in [0, 1] from which what cameras see is taken to be new.
        rate: learning rate of their places at the start and the end of a moment [scene bounds].
            Moments are short, and newcomers begin far from what they are to be.
        turn_rate: that of their rotations.
        scale_rate: that of the logarithms of their scales.
        opacity_rate: that of the logits of their opacities.
        colour_rate: that of their colours.
    """

    count: int = 500
    noticed: float = 0.15
    rate: tuple[float, float] = (3e-3, 1e-4)
    turn_rate: tuple[float, float] = (1e-2, 5e-4)
    scale_rate: tuple[float, float] = (2e-2, 5e-3)
    opacity_rate: tuple[float, float] = (0.1, 0.02)
    colour_rate: tuple[float, float] = (2e-2, 5e-3)

    def __post_init__(self) -> None:
        require(self, "count", self.count >= 1, "1 or more")
        require(self, "noticed", 0 < self.noticed < 1, "above 0, below 1")
        rates = "rate", "turn_rate", "scale_rate", "opacity_rate", "colour_rate"
        require_rates(self, *rates)


class Newcomers(Layer):
    """What the last S rows of the splats that move are, at every moment but the first.

    At the first the model has no such rows; ``rows_for`` says what is added as it ends. Between two
    moments newcomers are those of the earlier one.

    Attributes:
        newest: what they are at the newest moment; S splats, trained.
        past: K moments of each tensor (S, K, ...), of the moments between the first and the newest;
            while a stream is trained of the one before the newest alone.
        times: (K + 2,) float64 in [0, 1], of all moments.
        ready: (), 1 once the model has the rows.
    """

    def __init__(self, options: Options, bound: float, colours: tuple[int, ...]) -> None:
        self.options = options
        self.newest = _hidden(options.count, colours)
        rates = {
            "means": (bound * options.rate[0], bound * options.rate[1]),
            "quats": options.turn_rate,
            "log_scales": options.scale_rate,
            "logit_opacities": options.opacity_rate,
            "sh": options.colour_rate,
        }
        own = self.newest.tensors()
        self.past = {name: tensor.detach()[:, None].clone() for name, tensor in own.items()}
        self.times = torch.linspace(0, 1, 3, dtype=torch.float64)
        self.ready = torch.zeros((), dtype=torch.uint8)
        super().__init__(
            [
                *(Parameter(name, tensor, rate=rates[name]) for name, tensor in own.items()),
                *(Parameter(PAST + name, tensor) for name, tensor in self.past.items()),
                Parameter(TIMES, self.times),
                Parameter(READY, self.ready),
            ]
        )

    def __len__(self) -> int:
        return len(self.newest)

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment with newcomers in place of its last rows."""
        index = bisect_right(self.times.tolist(), instant.time) - 1
        if not self.ready or index <= 0:
            return moment
        first = len(moment) - len(self)
        own = self.newest.tensors()
        if index < len(self.times) - 1:
            own = {name: tensor[:, index - 1] for name, tensor in self.past.items()}
        splats = {
            name: torch.cat([tensor[:first], own[name]])
            for name, tensor in moment.splats.tensors().items()
        }
        return replace(moment, splats=Splats(**splats))

    @torch.no_grad()
    def rows_for(self, splats: Splats) -> Splats:
        """Return S rows that are not seen, to be the last of those of ``splats``, which move."""
        self.ready.fill_(1)
        hidden = _hidden(len(self), tuple(splats.sh.shape[1:])).map(lambda t: t.to(splats.means))
        hidden.means.copy_(splats.means.mean(dim=0))
        return hidden

    @torch.no_grad()
    def go_on(self, first: float, last: float, time: float) -> None:
        """Let the newest moment become the last one, and begin another with the same newcomers.

        Args:
            first: time of the first moment of all.
            last: time of the newest so far.
            time: of the one that begins.
        """
        for name, tensor in self.newest.tensors().items():
            self.past[name][:, 0] = tensor
        self.times.copy_(torch.tensor([first, last, time], dtype=torch.float64))

    def faded(self) -> Tensor:
        """Return which newcomers are free to be placed anew, (S,) bool."""
        return self.newest.logit_opacities.detach().sigmoid() < FADED

    @torch.no_grad()
    def appear(self, rows: Tensor, means: Tensor, log_scales: Tensor, colours: Tensor) -> None:
        """Place newcomers.

        Args:
            rows: (M,) int64, which.
            means: (M, 3) where [world units].
            log_scales: (M,) how large, all round.
            colours: (M, 3) in [0, 1], from all sides.
        """
        own = self.newest
        hidden = _hidden(len(rows), tuple(own.sh.shape[1:]))
        own.means[rows], own.quats[rows] = means.to(own.means), hidden.quats.to(own.quats)
        own.log_scales[rows] = log_scales.to(own.means)[:, None].expand(-1, 3)
        own.logit_opacities[rows] = math.log(BEGIN / (1 - BEGIN))
        own.sh[rows] = 0
        own.sh[rows, 0] = (colours.to(own.sh) - 0.5) / SH_C0

    @torch.no_grad()
    def mend(self) -> Tensor:
        """Hide newcomers that are not finite; return which those are, (S,) bool."""
        own = self.newest.tensors()
        lost = ~finite_rows(list(own.values()), len(self))
        if lost.any():
            hidden = _hidden(len(self), tuple(self.newest.sh.shape[1:])).tensors()
            for name, tensor in own.items():
                tensor[lost] = hidden[name].to(tensor)[lost]
        return lost

    def check(self) -> None:
        """Raise ValueError unless all tensors are of as many newcomers and moments."""
        Splats(**self.newest.tensors())
        for name, tensor in self.newest.tensors().items():
            expected = (len(self), len(self.times) - 2, *tensor.shape[1:])
            if tuple(self.past[name].shape) != expected:
                raise ValueError(f"{PAST}{name} has shape {tuple(self.past[name].shape)}")


def _hidden(count: int, colours: tuple[int, ...]) -> Splats:
    """Return splats that are not seen, with coefficients of their colours (K, 3)."""
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Splats(
        means=torch.zeros(count, 3),
        quats=quats,
        log_scales=torch.full((count, 3), _SMALL),
        logit_opacities=torch.full((count,), _HIDDEN),
        sh=torch.zeros(count, *colours),
    )


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Newcomers:
    """Return newcomers that are not there yet."""
    return Newcomers(options, facts.bound, tuple(splats.sh.shape[1:]))
