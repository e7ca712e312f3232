"""Gates the optimiser's steps by the saliency of splats, and updates the saliency by the steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import NAMES
from gsdmsr_cli.model.model import STORED_AS
from gsdmsr_cli.ops.adam import Gate
from gsdmsr_cli.training.gradients.phase import ViewGradients
from gsdmsr_cli.training.resizing import Population
from gsdmsr_cli.training.saliency import step_saliency


def gates_of(population: Population, step: int) -> dict[str, Gate]:
    """Return the gates of all trained tensors that have rows of splats, by name, for this step."""
    multipliers = population.saliency.multipliers(step)
    return {
        p.name: Gate(multipliers[: len(p.tensor)], torch.zeros_like(p.tensor))
        for p in population.model.parameters()
        if p.per_splat and p.rate is not None
    }


def observe_step(
    population: Population,
    views: Sequence[ViewGradients],
    gates: Mapping[str, Gate],
    loss: Tensor,
) -> None:
    """Update the saliency by a step of the optimiser.

    Args:
        population: after the step.
        views: of the step.
        gates: of the step, with its traces.
        loss: (), without which, if it is not finite, a GPU has made no step.
    """
    saliency, steps = population.saliency, {n: gates[STORED_AS + n].trace for n in NAMES}
    now = step_saliency(population.model.splats, steps, saliency.options.units == "raw")
    seen = torch.stack([view.on_screen for view in views]).any(dim=2).any(dim=0)
    woken = saliency.observe(now, seen if loss.is_cpu else seen & loss.isfinite())
    if woken.is_cpu and not woken.any():
        return
    # what they were about to do when they fell asleep is of no use any more
    for name, gate in gates.items():
        population.optimizer.reset_momentum(name, woken[: len(gate.multipliers)])
