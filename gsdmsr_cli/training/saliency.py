"""Finds the splats that the optimiser still changes (MS-DGO in GS-DMSR, Lu et al. 2026, 4.1).

The saliency of a splat is the weighted length of its last step, S = |W (a(t) - a(t - 1))|_1 over
position, rotation, scale and colour. Splats of low saliency have converged: their steps are scaled
down, left out altogether or taken now and then. What they would do is worked out all the same, so
that a splat whose surroundings change wakes up again.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.options.preset import SaliencyOptions

SPARSE_EVERY = 8
"""Interval at which splats of low saliency take their step where the gate is "sparse" [steps]."""

_STATE = "scores", "high", "age", "grace"


class Saliency:
    """How salient each of N splats is to the optimiser, and which of two classes it is in.

    Attributes:
        scores: (N,) saliency, smoothed over the steps in which the splat was seen.
        high: (N,) bool, the class.
        age: (N,) int64, steps since the class last changed.
        grace: (N,) int64, steps left in which the splat is high whatever its score.
    """

    def __init__(
        self, count: int, options: SaliencyOptions, device: torch.device | str = "cpu"
    ) -> None:
        self.options = options
        self.scores = torch.full((count,), options.threshold, device=device)
        self.high = torch.ones(count, dtype=torch.bool, device=device)
        self.age = torch.zeros(count, dtype=torch.int64, device=device)
        self.grace = torch.full((count,), options.grace, device=device)

    def multipliers(self, step: int) -> Tensor:
        """Return the (N,) factors on each splat's update in this step."""
        gate = self.options.gate
        low = {
            "scale": self.options.low_rate,
            "sparse": float(step % SPARSE_EVERY == 0),
            "freeze": 0.0,
        }[gate]
        return torch.where(self.high, 1.0, low)

    def gradient_mask(self, step: int) -> Tensor | None:
        """Return which (N,) splats that have gradients for shared fields, or None for all."""
        every = self.options.field_every
        return None if every and step % every == 0 else self.high

    def observe(self, now: Tensor, seen: Tensor) -> Tensor:
        """Update the scores by a step; return which splats (N,) have gone from low to high.

        Args:
            now: (N,) saliency of the step, see ``step_saliency``.
            seen: (N,) bool, the splats that any view of the step had a gradient for.
        """
        o = self.options
        smoothed = o.smoothing * self.scores + (1 - o.smoothing) * now
        self.scores = torch.where(seen & now.isfinite(), smoothed, self.scores)
        self.grace = (self.grace - 1).clamp(min=0)
        threshold = self._threshold()
        rises = ~self.high & (self.scores > threshold)
        falls = self.high & (self.scores < o.release * threshold) & (self.grace == 0)
        changes = (rises | falls) & (self.age >= o.hold)
        self.high = self.high ^ changes
        self.age = (self.age + 1).masked_fill(changes, 0)
        return changes & self.high

    def _threshold(self) -> Tensor | float:
        quantile, count = self.options.quantile, len(self.scores)
        if quantile == 0 or count == 0:
            return self.options.threshold
        return self.scores.kthvalue(max(1, round(quantile * count))).values

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow a resize; rows that are ``fresh`` (M,) begin high, in grace."""
        for name in _STATE:
            setattr(self, name, getattr(self, name)[rows])
        self.restart(fresh)

    def restart(self, rows: Tensor) -> None:
        """Let the splats ``rows`` (N,) bool begin anew: high, in grace."""
        self.scores[rows] = self.options.threshold
        self.high[rows] = True
        self.age[rows] = 0
        self.grace[rows] = self.options.grace

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by name."""
        return {name: getattr(self, name) for name in _STATE}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""
        for name in _STATE:
            setattr(self, name, tensors[name])


@torch.no_grad()
def step_saliency(splats: Splats, steps: Mapping[str, Tensor], raw: bool = False) -> Tensor:
    """Return S (N,) of what a step has subtracted, or would have, from each splat.

    In units that matter to the picture: the mean over position in units of the splat's own size,
    log scales, unit quaternion, and colour, each of these a mean over its components. The largest
    group would otherwise be the highest harmonics, whose rates never decay.

    Args:
        splats: N splats after the step.
        steps: by the name of the splats' tensor, of the same shape.
        raw: sum all components instead as they are stored, W = 1.
    """
    if raw:
        moved = [steps[name] for name in ("means", "quats", "log_scales", "sh")]
        return torch.stack([step.abs().flatten(1).sum(dim=1) for step in moved]).sum(dim=0)
    size = splats.log_scales.mean(dim=1).exp()
    before = normalize(splats.quats + steps["quats"], dim=1)
    parts = (
        steps["means"].abs().mean(dim=1) / size,
        steps["log_scales"].abs().mean(dim=1),
        (normalize(splats.quats, dim=1) - before).abs().mean(dim=1),
        SH_C0 * steps["sh"][:, 0].abs().mean(dim=1),
    )
    return torch.stack(parts).mean(dim=0)
