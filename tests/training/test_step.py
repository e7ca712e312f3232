"""What a step of training makes of gradients, in closed forms."""

from __future__ import annotations

from pathlib import Path

import torch
from motion_checks import model_of, splats_of, started
from training_checks import preset_of, trainer_of

from gsdmsr_cli.training.gradients.phase import Order, ViewGradients
from gsdmsr_cli.training.trainer import _set_gradients


def test_gradients_are_summed_and_regularisers_count_as_often_as_there_are_views() -> None:
    """Of three views and one pass of regularisers for every fourth step."""
    model = model_of(splats_of(4), started("static"))
    tensors = list(model.trained().values())
    views = [
        ViewGradients(
            torch.tensor(float(i)), [(i + 1.0) * torch.ones_like(t) for t in tensors],
            torch.zeros(4, 2), (8, 6),
        )
        for i in range(3)
    ]  # fmt: skip
    parts = [None, *(torch.full_like(t, 0.5) for t in tensors[1:])]
    loss = _set_gradients(model, views, (torch.tensor(0.25), parts))
    assert loss.item() == (0 + 1 + 2) / 3 + 4 * 0.25
    for i, tensor in enumerate(tensors):
        assert tensor.grad is not None
        assert (tensor.grad == 1 + 2 + 3 + (4 * 3 * 0.5 if i else 0)).all()


def test_statistics_are_told_width_before_height(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of())
    on_screen = torch.zeros(120, 2)
    on_screen[0], on_screen[1] = torch.tensor([0.1, 0.0]), torch.tensor([0.0, 0.1])
    view = ViewGradients(torch.tensor(1.0), [], on_screen, (60, 20))
    trainer._record([Order(0)], [view], 0.0, torch.tensor(1.0))
    found = trainer.population.statistics.mean()[:3]
    torch.testing.assert_close(found, torch.tensor([0.1 * 60 / 2, 0.1 * 20 / 2, 0.0]))


def test_harmonics_make_their_share_of_a_step(tiny_scene: Path) -> None:
    """A first step of Adam is as long as the rate, whatever the gradient."""
    options = ["optimizer.sh_rest=0.2", "optimizer.sh=[0.01,0.01]", "splats.sh_degree=1"]
    trainer = trainer_of(tiny_scene, preset_of(*options, "splats.sh_start=0"))
    before = trainer.model.splats.sh.detach().clone()
    trainer.step()
    moved = (trainer.model.splats.sh.detach() - before).abs()
    for part, length in ((moved[:, 1:], 0.2 * 0.01), (moved[:, :1], 0.01)):
        gone = part[part > 0.1 * length]
        assert len(gone) > 50
        torch.testing.assert_close(gone.median(), torch.tensor(length), rtol=1e-2, atol=0)
        assert gone.max() < 1.01 * length
