"""Looks at views some of whose pixels do not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from datasets import noise, write_picture
from torch import Tensor
from training_checks import preset_of, trainer_of

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.model import Model
from gsdmsr_cli.pictures import HalvedPictures, Pictures
from gsdmsr_cli.raster import best_engine, load_engine
from gsdmsr_cli.scene import View
from gsdmsr_cli.training.look import Look, Stage, compare
from gsdmsr_cli.training.trainer import Trainer

BACKGROUND = torch.tensor([1.0, 1.0, 1.0])


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of())


def half(height: int, width: int) -> Tensor:
    """A mask of the left half."""
    return (torch.arange(width) < width // 2).expand(height, width)


def look_at(
    trainer: Trainer, target: Tensor, ssim: float, counted: Tensor | None, engine: str = "cpu"
) -> Look:
    model: Model = trainer.model
    camera: Camera = trainer.observer.pictures.camera(trainer.views[0])
    weights = None
    return compare(
        load_engine(engine), model, model.splats, camera, BACKGROUND, target, ssim, 1, weights,
        counted,
    )  # fmt: skip


def gradients(look: Look) -> list[Tensor]:
    return [gradient for gradient in (*look.gradients, look.on_screen) if gradient is not None]


@pytest.mark.parametrize("ssim", [0.0, 0.2])
def test_what_does_not_count_may_be_anything(trainer: Trainer, ssim: float) -> None:
    target = trainer.observer.pictures.load(trainer.views[0])
    counted = half(*target.shape[1:])
    other = torch.where(counted, target, torch.from_numpy(noise(48, 48, 3)).permute(2, 0, 1))
    one, same = (look_at(trainer, picture, ssim, counted) for picture in (target, other))
    plain = look_at(trainer, other, ssim, None)
    # the windows of SSIM that reach beyond the middle see the true pixels there on both sides, and
    # which those are changes what they say of the pixels that count
    if ssim == 0:
        assert one.loss == same.loss != plain.loss
        for found, expected in zip(gradients(same), gradients(one), strict=True):
            assert torch.equal(found, expected)
        assert one.errors is not None and same.errors is not None
        assert torch.equal(one.errors, same.errors)
    else:
        assert (
            same.loss.item() == pytest.approx(one.loss.item(), rel=0.1)
            and plain.loss > 1.5 * one.loss
        )


@pytest.mark.parametrize("ssim", [0.0, 0.2])
@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_if_all_counts_nothing_changes(trainer: Trainer, ssim: float, engine: str) -> None:
    target = trainer.observer.pictures.load(trainer.views[0])
    everything = torch.ones(target.shape[1:], dtype=torch.bool)
    masked = look_at(trainer, target, ssim, everything, engine)
    plain = look_at(trainer, target, ssim, None)
    assert masked.loss.item() == pytest.approx(plain.loss.item(), rel=1e-4)
    for found, expected in zip(gradients(masked), gradients(plain), strict=True):
        scale = float(expected.abs().max())
        atol = 2e-3 * scale + 1e-8  # turns of round splats have no gradient but rounding errors
        torch.testing.assert_close(found, expected, atol=atol, rtol=1e-2)


def test_if_nothing_counts_there_is_nothing_to_learn(trainer: Trainer) -> None:
    target = trainer.observer.pictures.load(trainer.views[0])
    look = look_at(trainer, target, 0.2, torch.zeros(target.shape[1:], dtype=torch.bool))
    assert look.loss.item() == pytest.approx(0, abs=1e-5)  # SSIM in float32
    assert all(not gradient.any() for gradient in gradients(look))


@pytest.mark.parametrize("progress", [0.0, 0.9])
def test_training_leaves_out_what_masks_leave_out(
    trainer: Trainer, tmp_path: Path, progress: float
) -> None:
    """At half the size, with SSIM, and at the full size without."""
    mask = half(48, 48).numpy()
    write_picture(tmp_path / "mask.png", (255 * mask).astype(np.uint8)[..., None])
    view = replace(trainer.views[0], mask_path=tmp_path / "mask.png")
    stage = Stage(progress, moving=False)
    observer, model = trainer.observer, trainer.model
    drawn = best_engine("cpu").rasterize(model.splats, view.camera, BACKGROUND).means2d
    (look,) = observer.look(model, [view], stage, [None])
    (whole,) = observer.look(model, [trainer.views[0]], stage, [None])
    left = drawn[:, 0] < 10  # whose splats reach into the half that counts
    far_right = drawn[:, 0] > 44
    assert look.on_screen[left].any()
    assert not look.on_screen[far_right & (model.splats.log_scales.exp() < 0.05).all(1)].any()
    assert look.loss < whole.loss


def test_half_the_size_counts_where_half_of_the_pixels_do(tmp_path: Path) -> None:
    mask = np.zeros((4, 6, 1), np.uint8)
    mask[0, 0] = 255  # a quarter
    mask[2, :2] = 255  # a half
    mask[2:, 4:] = 255
    write_picture(tmp_path / "a.png", noise(4, 6, 3))
    write_picture(tmp_path / "mask.png", mask)
    camera = Camera(np.eye(4), 5.0, 5.0, 3.0, 2.0, 6, 4)
    view = View("a", camera, 0.0, "train", tmp_path / "a.png", mask_path=tmp_path / "mask.png")
    pictures = HalvedPictures(Pictures((1.0, 1.0, 1.0), 1, 1 << 20))
    counted = pictures.counted(view)
    assert counted is not None
    assert counted.tolist() == [[False, False, False], [True, False, True]]
    assert pictures.counted(replace(view, mask_path=None)) is None
