"""Gradients of views some of whose pixels do not count."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from datasets import noise
from torch import Tensor
from training_checks import preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.gradients.compare import compare
from gsdmsr_cli.training.gradients.phase import ViewGradients
from gsdmsr_cli.training.trainer import Trainer

BACKGROUND = torch.tensor([1.0, 1.0, 1.0])


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of())


def half(height: int, width: int) -> Tensor:
    """A mask of the left half."""
    return (torch.arange(width) < width // 2).expand(height, width)


def compared(
    trainer: Trainer, target: Tensor, ssim: float, counted: Tensor | None, engine: str = "cpu"
) -> ViewGradients:
    model: Model = trainer.model
    camera: Camera = trainer.renderer.pictures.camera(trainer.views[0])
    weights = None
    return compare(
        load_engine(engine), model, Moment(model.splats), camera, BACKGROUND, target, ssim, 1,
        weights, counted,
    )  # fmt: skip


def gradients(found: ViewGradients) -> list[Tensor]:
    return [gradient for gradient in (*found.gradients, found.on_screen) if gradient is not None]


@pytest.mark.parametrize("ssim", [0.0, 0.2])
def test_what_does_not_count_may_be_anything(trainer: Trainer, ssim: float) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    counted = half(*target.shape[1:])
    other = torch.where(counted, target, torch.from_numpy(noise(48, 48, 3)).permute(2, 0, 1))
    one, same = (compared(trainer, picture, ssim, counted) for picture in (target, other))
    plain = compared(trainer, other, ssim, None)
    # the windows of SSIM that reach beyond the middle see the true pixels there on both sides, and
    # which those are changes what they say of the pixels that count
    if ssim == 0:
        assert one.loss == same.loss != plain.loss
        for found, expected in zip(gradients(same), gradients(one), strict=True):
            assert torch.equal(found, expected)
        assert one.tile_errors is not None and same.tile_errors is not None
        assert torch.equal(one.tile_errors, same.tile_errors)
    else:
        assert (
            same.loss.item() == pytest.approx(one.loss.item(), rel=0.1)
            and plain.loss > 1.5 * one.loss
        )


@pytest.mark.parametrize("ssim", [0.0, 0.2])
@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_if_all_counts_nothing_changes(trainer: Trainer, ssim: float, engine: str) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    everything = torch.ones(target.shape[1:], dtype=torch.bool)
    masked = compared(trainer, target, ssim, everything, engine)
    plain = compared(trainer, target, ssim, None)
    assert masked.loss.item() == pytest.approx(plain.loss.item(), rel=1e-4)
    for found, expected in zip(gradients(masked), gradients(plain), strict=True):
        scale = float(expected.abs().max())
        atol = 2e-3 * scale + 1e-8  # turns of round splats have no gradient but rounding errors
        torch.testing.assert_close(found, expected, atol=atol, rtol=1e-2)


def test_if_nothing_counts_there_is_nothing_to_learn(trainer: Trainer) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    found = compared(trainer, target, 0.2, torch.zeros(target.shape[1:], dtype=torch.bool))
    assert found.loss.item() == pytest.approx(0, abs=1e-5)  # SSIM in float32
    assert all(not gradient.any() for gradient in gradients(found))
