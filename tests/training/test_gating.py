"""Which splats a step has seen, and what those that wake up forget."""

from __future__ import annotations

from pathlib import Path

import torch
from training_checks import preset_of, trainer_of

from gsdmsr_cli.training.gating import gates_of, observe_step
from gsdmsr_cli.training.gradients.phase import ViewGradients

OPTIONS = (
    "density.until=0.2", "saliency.gate=freeze", "saliency.threshold=0.5", "saliency.smoothing=0",
    "saliency.hold=0", "saliency.grace=0", "training.static_until=0",
)  # fmt: skip


def test_what_any_view_has_seen_and_what_wakes_up(tiny_scene: Path) -> None:
    """Rows 0 to 2 would go far: 0 is seen by one view, 1 by the other, 2 and all others by none."""
    trainer = trainer_of(tiny_scene, preset_of(*OPTIONS))
    for _ in range(8):
        trainer.step()
    population, count = trainer.population, len(trainer.model.splats)
    first = population.optimizer.first
    for name in ("splats.means", "motion.embeddings"):
        first[name].fill_(0.25)
    population.saliency.high[:] = False
    population.saliency.scores[:] = 0.125
    gates = gates_of(population, trainer.clock.step)
    assert {"splats.means", "motion.embeddings"} <= gates.keys()
    gates["splats.log_scales"].trace[:3] = 12.0  # a mean of 12 of one group in four: 3
    on_screen = torch.zeros(2, count, 2)
    on_screen[0, 0, 0] = on_screen[1, 1, 1] = 1e-9
    views = [ViewGradients(torch.zeros(()), [], own, (48, 48)) for own in on_screen]
    observe_step(population, views, gates, torch.zeros(()))
    awake = torch.arange(count) < 2
    assert torch.equal(population.saliency.high, awake)
    torch.testing.assert_close(population.saliency.scores, torch.where(awake, 3.0, 0.125))
    for name in ("splats.means", "motion.embeddings"):
        assert torch.equal((first[name] == 0).all(dim=1), awake), name
        assert (first[name][2:] == 0.25).all(), name
