"""Steps that a GPU replays as CUDA graphs, where there is one: their gradients are those of steps
that are launched one by one, whatever views they are of, and so is what a training comes to."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from training_checks import preset_of

from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.gradients.phase import Order, Phase
from gsdmsr_cli.training.gradients.replays import Replays
from gsdmsr_cli.training.trainer import Trainer

DEVICE = "cuda"
REORDERED = 1e-4
"""Of the length of a gradient: sums by atomic additions have no fixed order."""

pytestmark = pytest.mark.skipif(
    availability.missing() is not None, reason=availability.missing() or ""
)


def trainer_of(scene: Path, *options: str, motion: str = "control_points") -> Trainer:
    preset = preset_of("training.low_resolution_until=0", *options, motion=motion)
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 24)
    return Trainer(read_scene(scene), preset, best_engine(DEVICE), pictures, DEVICE)


@pytest.mark.parametrize("motion", ["control_points", "hexplane", "multiscale", "static"])
@pytest.mark.parametrize("ssim", [0.0, 0.2])
@pytest.mark.parametrize("masked", [False, True])
def test_gradients_are_those_of_single_launches(
    tiny_scene: Path, motion: str, ssim: float, masked: bool
) -> None:
    options = "training.views_per_step=3", "training.static_until=0", "losses.ssim_until=1"
    trainer = trainer_of(tiny_scene, *options, f"losses.ssim={ssim}", motion=motion)
    for _ in range(5):
        trainer.step()
    renderer, model = trainer.renderer, trainer.model
    assert renderer._replays.able
    for rows in ((0, 1, 2), (0, 1, 2), (3, 4, 5), (2, 2, 0), (5, 1, 3)):
        orders = [Order(row) for row in rows]
        mask = torch.rand(len(model.splats), device=DEVICE) < 0.5 if masked else None
        phase = Phase(0.5, True, mask)
        replays = renderer._replays
        found = renderer.gradients(model, orders, phase)
        seen = [(view.loss.clone(), view.on_screen.clone()) for view in found]
        gradients = [None if g is None else g.clone() for g in found[0].gradients]
        renderer._replays = Replays(None)
        direct = renderer.gradients(model, orders, phase)
        renderer._replays = replays
        for (loss, on_screen), view in zip(seen, direct, strict=True):
            torch.testing.assert_close(loss, view.loss)
            close(on_screen, view.on_screen)
        for one, other in zip(gradients, direct[0].gradients, strict=True):
            assert (one is None) == (other is None)
            if one is not None and other is not None:
                close(one, other)
    assert replays._recording is not None


def test_a_training_comes_to_what_one_without_comes_to(tiny_scene: Path) -> None:
    def train(graphs: str) -> tuple[float, bool]:
        trainer = trainer_of(
            tiny_scene, "training.views_per_step=4", "training.steps=200", "motion.count=50",
            "density.every=20", f"training.cuda_graphs={graphs}",
        )  # fmt: skip
        losses = [trainer.step().loss for _ in range(200)]
        return float(torch.stack(losses[-20:]).mean()), trainer.renderer._replays.able

    (with_graphs, able), (without, unable) = train("true"), train("false")
    assert able and not unable
    assert with_graphs == pytest.approx(without, rel=0.15)


def close(found: torch.Tensor, expected: torch.Tensor) -> None:
    assert found.isfinite().all()
    assert (found - expected).norm() <= REORDERED * expected.norm() + 1e-9
