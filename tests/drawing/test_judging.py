"""What another model loses is measured against pictures, or against the model itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_checks import disturbed, splats_of, started
from torch import Tensor

from gsdmsr_cli.drawing.judging import ASSUMED, Judge
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera, look_at

BEHIND = torch.ones(3)


def camera() -> Camera:
    pose = look_at(np.array([0.0, -5.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 60.0, 60.0, 24.0, 20.0, 48, 40)


def model_of(splats: Splats) -> Model:
    return Model(splats, {MOTION: disturbed(started("static", len(splats)))})


def drawn(model: Model) -> Tensor:
    with torch.no_grad():
        return draw(model, camera(), 0.5, best_engine("cpu"), BEHIND).rgb.clamp(0, 1)


@pytest.fixture
def models() -> tuple[Model, Model]:
    splats = splats_of(50)
    return model_of(splats), model_of(replace(splats, sh=splats.sh + 0.02))


def judge_of(model: Model, pictures: list[Tensor] | None) -> Judge:
    return Judge(model, [(camera(), 0.5)], pictures, best_engine("cpu"), BEHIND)


def test_against_pictures(models: tuple[Model, Model]) -> None:
    model, other = models
    truth = (drawn(model) * 255 + 7).clamp(0, 255).round().to(torch.uint8)
    judge = judge_of(model, [truth.permute(2, 0, 1).contiguous()])
    before, after = ((drawn(m) - truth / 255).square().mean().item() for m in models)
    assert judge.psnr is not None and math.isclose(
        judge.psnr, -10 * math.log10(before), rel_tol=1e-5
    )
    loss = judge.loss(other)
    assert math.isclose(loss.measured, 10 * math.log10(after / before), abs_tol=1e-4)
    apart = (drawn(other) - drawn(model)).square().mean().item()
    assert math.isclose(loss.expected, 10 * math.log10(1 + apart / before), abs_tol=1e-4)
    assert judge.loss(model).measured == pytest.approx(0, abs=1e-9)


def test_without_pictures_the_model_is_the_truth(models: tuple[Model, Model]) -> None:
    model, other = models
    judge = judge_of(model, None)
    assert judge.psnr is None and not judge.knows_truth
    apart = (drawn(other) - drawn(model)).square().mean().item()
    loss = judge.loss(other)
    assert loss.measured == loss.expected
    assert math.isclose(loss.measured, 10 * math.log10(1 + apart / ASSUMED), rel_tol=1e-4)
