"""Rendering views in training: some of their pixels may not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from datasets import noise, write_picture
from training_checks import preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.scene.scene import MASK, View
from gsdmsr_cli.training.gradients.phase import Order, Phase
from gsdmsr_cli.training.trainer import Trainer

BACKGROUND = torch.tensor([1.0, 1.0, 1.0])


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of())


@pytest.mark.parametrize("progress", [0.0, 0.9])
def test_training_leaves_out_what_masks_leave_out(
    trainer: Trainer, tmp_path: Path, progress: float
) -> None:
    """At half the size, with SSIM, and at the full size without."""
    mask = (np.arange(48) < 24)[None].repeat(48, axis=0)
    write_picture(tmp_path / "mask.png", (255 * mask).astype(np.uint8)[..., None])
    view = replace(trainer.views[0], signals={MASK: tmp_path / "mask.png"})
    phase = Phase(progress, moving=False)
    renderer, model = trainer.renderer, trainer.model
    drawn = best_engine("cpu").rasterize(Moment(model.splats), view.camera, BACKGROUND).means2d
    (whole,) = renderer.gradients(model, [Order(0)], phase)
    renderer.views = [view]
    (masked,) = renderer.gradients(model, [Order(0)], phase)
    left = drawn[:, 0] < 10  # whose splats reach into the half that counts
    far_right = drawn[:, 0] > 44
    assert masked.on_screen[left].any()
    assert not masked.on_screen[far_right & (model.splats.log_scales.exp() < 0.05).all(1)].any()
    assert masked.loss < whole.loss


def test_half_the_size_counts_where_half_of_the_pixels_do(tmp_path: Path) -> None:
    mask = np.zeros((4, 6, 1), np.uint8)
    mask[0, 0] = 255  # a quarter
    mask[2, :2] = 255  # a half
    mask[2:, 4:] = 255
    write_picture(tmp_path / "a.png", noise(4, 6, 3))
    write_picture(tmp_path / "mask.png", mask)
    camera = Camera(np.eye(4), 5.0, 5.0, 3.0, 2.0, 6, 4)
    signals = {MASK: tmp_path / "mask.png"}
    view = View("a", camera, 0.0, "train", tmp_path / "a.png", signals)
    pictures = HalvedPictures(Pictures((1.0, 1.0, 1.0), 1, 1 << 20))
    counted = pictures.signal(view, MASK)
    assert counted is not None
    assert counted.tolist() == [[False, False, False], [True, False, True]]
    assert pictures.signal(replace(view, signals={}), MASK) is None
