"""Exposures: affine transforms of colours, whose mean changes nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kernel_checks import generator
from layer_checks import started_layer
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.layers.exposure import Exposure
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera, look_at

HEIGHT, WIDTH = 6, 7
REFERENCE = load_engine("reference")


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
    layer.parameters()[0].set_values(layer.values.double())
    with torch.no_grad():
        layer.values += 0.1 * torch.randn(layer.values.shape, generator=generator(2)).double()
    return layer


def moment_of(degree: int = 1) -> Moment:
    """Return splats of different colours, all between black and the brightest."""
    rng = generator(5)
    means = 0.5 * torch.randn(9, 3, generator=rng, dtype=torch.float64)
    sh = 0.2 * torch.randn(9, (degree + 1) ** 2, 3, generator=rng, dtype=torch.float64)
    quats = torch.randn(9, 4, generator=rng, dtype=torch.float64)
    log_scales = torch.full((9, 3), -0.5, dtype=torch.float64)
    return Moment(Splats(means, quats, log_scales, torch.ones(9).double(), sh))


def drawn(moment: Moment, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the picture before black, and what the splats cover of it."""
    frame = REFERENCE.rasterize(moment, camera, torch.zeros(3, dtype=torch.float64))
    return frame.rgb, frame.alpha


def shown(layer: Exposure, camera: Camera, time: float) -> Tensor:
    return drawn(layer.as_seen(moment_of(), Instant(time, view=camera)), WALK[0][0])[0]


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_colours_become_what_the_transform_says(degree: int) -> None:
    layer, moment = layer_of(WALK), moment_of(degree)
    change = (layer.values[3] - layer.values.mean(dim=0)).detach()
    camera, time = WALK[3]
    colours, cover = drawn(moment, camera)
    assert cover.max() > 0.9
    found, covered = drawn(layer.as_seen(moment, Instant(time, view=camera)), camera)
    expected = colours + colours @ change[:, :3].T + cover[..., None] * change[:, 3]
    torch.testing.assert_close(found, expected)
    assert torch.equal(cover, covered)


def test_the_mean_of_all_changes_nothing() -> None:
    layer = layer_of(WALK)
    mean = torch.stack([shown(layer, *view) for view in WALK]).mean(dim=0)
    torch.testing.assert_close(mean, drawn(moment_of(), WALK[0][0])[0])


def test_other_views_of_the_path_lie_between_their_neighbours() -> None:
    layer = layer_of(WALK)
    before, after = shown(layer, *WALK[1]), shown(layer, *WALK[2])
    found = shown(layer, camera_at(0.02 * 1.4), 0.35)
    torch.testing.assert_close(found, 0.6 * before + 0.4 * after)


@pytest.mark.parametrize("view", [None, camera_at(2.0)])
def test_cameras_that_nobody_held_show_mean_colours(view: Camera | None) -> None:
    moment = moment_of()
    assert layer_of(WALK).as_seen(moment, Instant(0.5, view=view)) is moment


def test_a_rigs_cameras_keep_theirs_and_its_unseen_one_shows_mean_colours() -> None:
    layer, moment = layer_of(RIG), moment_of()
    assert len(layer.values) == 2
    assert torch.equal(shown(layer, RIG[0][0], 0.0), shown(layer, RIG[0][0], 0.31))
    assert layer.as_seen(moment, Instant(0.0, view=camera_at(0.25))) is moment
    assert len(layer_of(RIG, per="frame").values) == 6


def test_gradients_are_those_of_differences() -> None:
    layer, moment = layer_of(WALK), moment_of()
    camera, time = WALK[3]
    mean = layer.values.detach().mean(dim=0)
    sh = moment.splats.sh.requires_grad_()
    weights = torch.rand(sh.shape, generator=generator(6), dtype=torch.float64)

    def value(row: Tensor, colours: Tensor) -> Tensor:
        """Return the weighted sum of what the definition makes of coefficients."""
        change = row - mean
        seen = colours + colours @ change[:, :3].T
        first = (change[:, :3].sum(dim=1) / 2 + change[:, 3]) / 0.28209479177387814
        return (seen * weights).sum() + (first * weights[:, 0]).sum()

    seen = layer.as_seen(moment, Instant(time, view=camera)).splats.sh
    loss = (seen * weights).sum()
    row = layer.values[3].detach().clone().requires_grad_()
    expected = torch.autograd.grad(value(row, sh), [row, sh])
    found, by_colours = torch.autograd.grad(loss, [layer.values, sh])
    assert not found[[0, 1, 2, 4]].any(), "a view says nothing of others"
    torch.testing.assert_close(loss, value(row, sh))
    torch.testing.assert_close(found[3], expected[0])
    torch.testing.assert_close(by_colours, expected[1])


def test_splats_that_are_not_finite_spoil_no_transform() -> None:
    layer, moment = layer_of(WALK), moment_of()
    camera, time = WALK[3]
    moment.splats.sh[4, 0, 1] = math.nan
    picture, _ = drawn(layer.as_seen(moment, Instant(time, view=camera)), camera)
    (found,) = torch.autograd.grad(picture.sum(), layer.values)
    assert picture.isfinite().all() and found.isfinite().all() and found.any()


def test_before_it_learns_it_does_nothing() -> None:
    layer = layer_of(WALK, since=0.5)
    layer.advance(0.4)
    assert layer.penalty(None, Instant(0.0), generator()) is None  # type: ignore[arg-type]
    assert not shown(layer, *WALK[3]).requires_grad
