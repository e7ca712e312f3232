"""Splats change little from one time to the next: positions, rotations and scales.

The temporal smoothness of Gaussian-Flow (Lin et al., CVPR 2024, section 3.4), as a rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.training.losses import Seen
from gsdmsr_cli.training.losses._comparing import ComparingTerm, Schedule, finite_rows_of, nothing


@dataclass(frozen=True)
class Options(Schedule):
    """Settings; see ``Schedule``.

    Attributes:
        factor: weight of the mean squared rate of change.
    """

    factor: float = 1e-4


class TemporalSmoothness(ComparingTerm):
    """The mean over the splats of |change / time|^2, from a view's time to an adjacent one.

    Positions count in world units, rotations as unit quaternions, scales as logarithms; the time is
    a share of the whole capture.
    """

    def __call__(self, seen: Seen) -> Tensor:
        """Return the mean ()."""
        if seen.other is None or seen.other_instant is None:
            return nothing(seen)
        rows = finite_rows_of(seen.moment.splats, seen.other.splats)
        now, other = (_compared(one.splats, rows) for one in (seen.moment, seen.other))
        time = seen.instant.time - seen.other_instant.time
        return ((now - other) / time).square().sum() / max(len(rows), 1)


def _compared(splats: Splats, rows: Tensor) -> Tensor:
    """Return what is compared of the rows (M,), (M, 10)."""
    turns = normalize(splats.quats[rows], dim=1)
    return torch.cat([splats.means[rows], turns, splats.log_scales[rows]], dim=1)


def start(options: Options) -> TemporalSmoothness:
    """Return the term."""
    return TemporalSmoothness(options)
