"""Draws rotations and scales as codes (Compact 3DGS, Lee et al., CVPR 2024, section 3.2).

They are sums of codes from residual codebooks, as a compact file stores them. Values that are
trained pass gradients on as if they were drawn exactly. What else such a file rounds
(``runs.packing``) is rounded too finely to matter in training.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.strict import require

BOOKS = {"quats": 4, "log_scales": 3}
"""What has a codebook, and the length of its codes."""

_ROUNDS = 10
"""Of k-means for each stage of a codebook."""


@dataclass(frozen=True)
class Options:
    """Settings of the codebooks, which the event ``codebooks`` fits.

    Attributes:
        stages: how many codes are added up, 1 to 16; each stands for what the former leave.
        codes: of each stage, 2 to 256.
        rate: learning rate of the codebooks, [start, end].
    """

    stages: int = 6
    codes: int = 64
    rate: tuple[float, float] = (1e-4, 1e-4)

    def __post_init__(self) -> None:
        require(self, "stages", 1 <= self.stages <= 16, "1 to 16")
        require(self, "codes", 2 <= self.codes <= 256, "2 to 256")
        require(self, "rate", min(self.rate) > 0, "[start, end], both above 0")


class Quantise(Layer):
    """Residual vector quantisation of rotations and scales."""

    concerns_still = True
    before_motion = True

    def __init__(self, options: Options) -> None:
        self.options = o = options
        self.books = {name: torch.zeros(o.stages, o.codes, width) for name, width in BOOKS.items()}
        self.fitted = torch.zeros(1)
        self._active = False
        books = [Parameter(name, book, rate=o.rate) for name, book in self.books.items()]
        super().__init__([*books, Parameter("fitted", self.fitted)])

    def advance(self, progress: float) -> None:
        """Draw quantised splats once the codebooks have been fitted, by another process maybe."""
        if self.fitted.is_cpu:  # on a GPU, which is not waited for, there is one process
            self._active = bool(self.fitted.any())

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats as codes have them; those given, before the codebooks are fitted."""
        if not self._active:
            return moment
        splats, codes = moment.splats, self.encode(moment.splats)
        stored = {
            name: _straight(getattr(splats, name), decode(codes[name], book))
            for name, book in self.books.items()
        }
        return replace(moment, splats=replace(splats, **stored))

    @torch.no_grad()
    def encode(self, splats: Splats) -> dict[str, Tensor]:
        """Return the codes (N, stages) int64 of what has a codebook."""
        found = {}
        for name, book in self.books.items():
            rest, codes = getattr(splats, name).detach(), []
            for stage in book:
                codes.append(_nearest(rest, stage))
                rest = rest - stage[codes[-1]]
            found[name] = torch.stack(codes, dim=1)
        return found

    @torch.no_grad()
    def fit(self, splats: Splats, generator: torch.Generator) -> None:
        """Let the codebooks stand for these splats, by k-means stage by stage."""
        for name, book in self.books.items():
            rest = getattr(splats, name).detach()
            for stage in book:
                stage.copy_(_k_means(rest, len(stage), generator))
                rest = rest - stage[_nearest(rest, stage)]
        self.fitted.fill_(1.0)
        self._active = True

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return how far codes are from what they stand for: the sum over stages, a mean over
        splats, of squared distances that move the codes alone."""
        if not self._active:
            return None
        codes, parts = self.encode(moment.splats), []
        for name, book in self.books.items():
            rest = getattr(moment.splats, name).detach()
            for stage, chosen in zip(book, codes[name].unbind(1), strict=True):
                code = stage[chosen]
                parts.append((rest - code).square().sum(dim=1).mean())
                rest = rest - code.detach()
        return torch.stack(parts).sum()

    def check(self) -> None:
        """Raise ValueError unless the codebooks have codes of the right length."""
        for name, book in self.books.items():
            if book.shape[2] != BOOKS[name] or not 1 <= book.shape[1] <= 256:
                raise ValueError(f"a codebook of shape {tuple(book.shape)} for '{name}'")
        self._active = bool(self.fitted.any())


def decode(codes: Tensor, book: Tensor) -> Tensor:
    """Return the sums (N, width) of the codes (N, stages) of a book (stages, codes, width)."""
    own = book.detach()
    total = torch.zeros(len(codes), own.shape[2], device=own.device)
    for stage, chosen in zip(own, codes.unbind(1), strict=True):
        total = total + stage[chosen]
    return total


def _straight(value: Tensor, stored: Tensor) -> Tensor:
    """Return ``stored`` exactly, with the gradient of ``value``."""
    return stored + (value - value.detach())


def _nearest(rows: Tensor, codes: Tensor) -> Tensor:
    """Return the code (N,) that is nearest to each row (N, K)."""
    return (codes.square().sum(dim=1) - 2 * rows @ codes.T).argmin(dim=1)


def _k_means(rows: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return the centres (count, K) of rows (N, K); those that nothing is near to stay."""
    chosen = torch.randint(len(rows), (count,), generator=generator)
    centres = rows[chosen.to(rows.device)].clone()
    for _ in range(_ROUNDS):
        near = _nearest(rows, centres)
        sums = torch.zeros_like(centres).index_add_(0, near, rows)
        counts = rows.new_zeros(count).index_add_(0, near, rows.new_ones(len(rows)))[:, None]
        centres = torch.where(counts > 0, sums / counts.clamp(min=1), centres)
    return centres


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Quantise:
    """Return a layer that changes nothing until its codebooks have been fitted."""
    return Quantise(options)
