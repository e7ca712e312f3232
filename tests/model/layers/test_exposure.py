"""Exposures: affine transforms of colours, whose mean changes nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kernel_checks import generator
from layer_checks import started_layer

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.layers.exposure import Exposure
from gsdmsr_cli.scene.camera import Camera, look_at

HEIGHT, WIDTH = 6, 7


def camera_at(azimuth: float) -> Camera:
    centre = 4 * np.array([math.cos(azimuth), math.sin(azimuth), 0.2])
    pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 9.0, 9.0, 3.5, 3.0, WIDTH, HEIGHT)


WALK = [(camera_at(0.02 * i), i / 4) for i in range(5)]
RIG = [(camera_at(0.5 * c), t / 2) for t in range(3) for c in range(2)]


def layer_of(views: list[tuple[Camera, float]], **options: object) -> Exposure:
    layer = started_layer("exposure", **options)
    assert isinstance(layer, Exposure)
    layer.begin_with(views)
    layer.advance(1.0)
    with torch.no_grad():
        layer.values += 0.2 * torch.randn(layer.values.shape, generator=generator(2))
    return layer


def frame_of() -> Frame:
    rng = generator(5)
    rgb = torch.rand(HEIGHT, WIDTH, 3, generator=rng, dtype=torch.float64)
    alpha = torch.rand(HEIGHT, WIDTH, generator=rng, dtype=torch.float64)
    return Frame(rgb, alpha, None, torch.zeros(1), torch.zeros(1, 2))


def shown(layer: Exposure, camera: Camera, time: float) -> torch.Tensor:
    layer.parameters()[0].set_values(layer.values.double())
    return layer.shade(frame_of(), Instant(time, view=camera)).rgb


def test_colours_become_what_the_transform_says_where_something_is() -> None:
    layer, frame = layer_of(WALK), frame_of()
    change = (layer.values[3] - layer.values.mean(dim=0)).double().detach()
    expected = frame.rgb.clone()
    for row in range(HEIGHT):
        for column in range(WIDTH):
            colour = frame.rgb[row, column]
            added = change[:, :3] @ colour + change[:, 3]
            expected[row, column] = colour + frame.alpha[row, column] * added
    torch.testing.assert_close(shown(layer, *WALK[3]), expected, rtol=1e-6, atol=1e-6)


def test_the_mean_of_all_changes_nothing() -> None:
    layer = layer_of(WALK)
    mean = torch.stack([shown(layer, *view) for view in WALK]).mean(dim=0)
    torch.testing.assert_close(mean, frame_of().rgb, rtol=1e-6, atol=1e-6)


def test_other_views_of_the_path_lie_between_their_neighbours() -> None:
    layer = layer_of(WALK)
    before, after = shown(layer, *WALK[1]), shown(layer, *WALK[2])
    found = shown(layer, camera_at(0.02 * 1.4), 0.35)
    torch.testing.assert_close(found, 0.6 * before + 0.4 * after)


@pytest.mark.parametrize("view", [None, camera_at(2.0)])
def test_cameras_that_nobody_held_show_mean_colours(view: Camera | None) -> None:
    frame = frame_of()
    assert layer_of(WALK).shade(frame, Instant(0.5, view=view)) is frame


def test_a_rigs_cameras_keep_theirs_and_its_unseen_one_shows_mean_colours() -> None:
    layer = layer_of(RIG)
    assert len(layer.values) == 2
    torch.testing.assert_close(shown(layer, RIG[0][0], 0.0), shown(layer, RIG[0][0], 0.31))
    assert layer.shade(frame := frame_of(), Instant(0.0, view=camera_at(0.25))) is frame
    assert len(layer_of(RIG, per="frame").values) == 6


def test_gradients_are_those_of_differences() -> None:
    layer = layer_of(WALK)
    weights = torch.rand(HEIGHT, WIDTH, 3, generator=generator(6), dtype=torch.float64)
    (found,) = torch.autograd.grad((shown(layer, *WALK[3]) * weights).sum(), layer.values)
    assert not found[[0, 1, 2, 4]].any(), "a view says nothing of others"
    frame, mean = frame_of(), layer.values.detach().mean(dim=0)

    def value(row: torch.Tensor) -> torch.Tensor:
        change = row - mean
        added = frame.rgb @ change[:, :3].T + change[:, 3]
        return ((frame.rgb + frame.alpha[..., None] * added) * weights).sum()

    row = layer.values[3].detach()
    for i in range(3):
        for j in range(4):
            step = torch.zeros(3, 4).double()
            step[i, j] = 1e-4
            slope = (value(row + step) - value(row - step)) / 2e-4
            torch.testing.assert_close(found[3, i, j], slope, rtol=1e-6, atol=1e-6)


def test_before_it_learns_it_does_nothing() -> None:
    layer = layer_of(WALK, since=0.5)
    layer.advance(0.4)
    assert layer.penalty(None, Instant(0.0), generator()) is None  # type: ignore[arg-type]
    assert not shown(layer, *WALK[3]).requires_grad
