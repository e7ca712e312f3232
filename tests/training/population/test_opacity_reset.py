"""Lowering all opacities."""

from __future__ import annotations

import math

import pytest
import torch
from motion_checks import splats_of

from gsdmsr_cli.training.population.opacity_reset import reset_opacities


def test_reset_lowers_opacities_and_raises_none() -> None:
    splats = splats_of(3)
    splats.logit_opacities[:] = torch.tensor([4.0, math.log(0.03 / 0.97), -7.0])
    reset_opacities(splats.map(torch.nn.Parameter), 0.03)
    assert torch.sigmoid(splats.logit_opacities).tolist() == pytest.approx(
        [0.03, 0.03, 1 / (1 + math.exp(7))], rel=1e-4
    )
