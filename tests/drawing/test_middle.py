"""The middle of what is drawn: found where an object stands free, and left open elsewhere."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_checks import splats_of, started

from gsdmsr_cli.drawing.middle import middle
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera, look_at

WHERE = np.array([0.3, -0.2, 0.5])
Shots = list[tuple[Camera, float]]


def ball(extent: float, logit_opacity: float = 2.0) -> Splats:
    """Return splats evenly in a ball about ``WHERE``, and invisible ones far from it."""
    generator = torch.Generator().manual_seed(0)
    splats = splats_of(400)
    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator))
    radii = extent * torch.rand(400, 1, generator=generator) ** (1 / 3)
    means = directions * radii + torch.tensor(WHERE, dtype=torch.float32)
    means[:100] = torch.tensor([0.0, 0.0, -1.0])
    opacities = torch.full((400,), logit_opacity)
    opacities[:100] = -20
    scales = torch.full((400, 3), math.log(0.05 * extent))
    return replace(splats, means=means, logit_opacities=opacities, log_scales=scales)


def model_of(splats: Splats) -> Model:
    return Model(splats, {MOTION: started("static", len(splats))})


def around(count: int = 8, turn: float = 2 * math.pi, size: tuple[int, int] = (200, 160)) -> Shots:
    """Return cameras that all face the world's origin."""
    shots = []
    for i in range(count):
        angle, height = turn * i / count, 0.2 + 0.1 * (i % 4)
        where = 4 * np.array([math.cos(angle), math.sin(angle), height])
        pose = look_at(where, np.zeros(3), np.array([0.0, 0.0, 1.0]))
        shots.append((Camera(pose, 200.0, 210.0, 90.0, 85.0, *size), i / count))
    return shots


def test_the_middle_is_where_the_object_stands_not_where_cameras_look() -> None:
    found = middle(model_of(ball(0.4)), around(), best_engine("cpu"))
    assert found == pytest.approx(WHERE, abs=0.03)


@pytest.mark.parametrize("extent", [8.0, 2.0])
def test_pictures_filled_to_their_edges_have_no_middle(extent: float) -> None:
    assert middle(model_of(ball(extent)), around(), best_engine("cpu")) is None


def test_cameras_in_one_direction_do_not_tell_how_far_it_is() -> None:
    assert middle(model_of(ball(0.4)), around(turn=0.1)[:1], best_engine("cpu")) is None
    assert middle(model_of(ball(0.4)), around(turn=0.1), best_engine("cpu")) is None


def test_a_few_pictures_that_cut_the_object_are_left_out() -> None:
    near = [(replace(camera, fx=2000.0, fy=2000.0), time) for camera, time in around(6)]
    shots = around()
    assert middle(model_of(ball(0.4)), shots + near, best_engine("cpu")) == pytest.approx(
        WHERE, abs=0.03
    )
    assert middle(model_of(ball(0.4)), shots[:5] + near, best_engine("cpu")) is None


def test_nothing_has_no_middle() -> None:
    assert middle(model_of(ball(0.4, -20.0)), around(), best_engine("cpu")) is None
