"""Corrections of cameras: what they do to a camera, and their gradients against differences."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_checks import generator
from layer_checks import started_layer
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.layers.cameras import Cameras, corrected
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera, look_at

UP = np.array([0.0, 0.0, 1.0])
VIEWS = [
    (Camera(look_at(np.array([3.0, y, z]), np.zeros(3), UP), 22.0, 24.0, 11.0, 9.0, 24, 18), t)
    for y, z, t in [(-0.2, 0.0, 0.0), (-0.1, 0.06, 0.25), (0.0, 0.12, 0.5), (0.1, 0.18, 0.75),
                    (0.2, 0.24, 1.0)]
]  # fmt: skip


def layer_of(scale: float = 0.02, dtype: torch.dtype = torch.float64, **options: object) -> Cameras:
    """Return a layer that learns, with corrections of about this size [rad, scene bounds]."""
    layer = started_layer("cameras", **options)
    assert isinstance(layer, Cameras)
    layer.begin_with(VIEWS)
    layer.advance(1.0)
    values = scale * torch.randn(len(VIEWS), 6, generator=generator(3))
    layer.parameters()[0].set_values(values.to(dtype))
    return layer


def focal_layer(dtype: torch.dtype = torch.float64) -> Cameras:
    """Return such a layer with a focal length that is 5 % longer."""
    layer = layer_of(0.05, dtype, focal=True)
    layer.parameters()[-1].set_values(torch.tensor([math.log(1.05)], dtype=dtype))
    return layer


def moment_of(degree: int, with_axes: bool, dtype: torch.dtype = torch.float64) -> Moment:
    """Return eight splats that all cameras see, in whose harmonics directions matter."""
    rng = generator(degree)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3)]
    means, quats, scales, logits, sh = (
        torch.randn(8, *shape, generator=rng).to(dtype) for shape in shapes
    )
    splats = Splats(0.5 * means, quats, 0.3 * scales - 1.5, logits, 0.5 * sh)
    splats = splats.map(lambda t: t.requires_grad_(True))
    if not with_axes:
        return Moment(splats)
    return Moment(splats, scaled_axes(splats.quats, splats.log_scales).detach().requires_grad_())


def loss_of(layer: Cameras, moment: Moment, weights: Tensor, engine: str = "reference") -> Tensor:
    camera, time = VIEWS[2]
    seen = layer.as_seen(moment, Instant(time, view=camera))
    frame = load_engine(engine).rasterize(
        seen, layer.place(camera, time), torch.ones(3, dtype=weights.dtype)
    )
    return (frame.rgb * weights).sum()


def weights_of(dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(18, 24, 3, generator=generator(7)).to(dtype)


@pytest.mark.parametrize("with_axes", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_are_those_of_differences(degree: int, with_axes: bool) -> None:
    """Of the camera that is placed: splats, harmonics and the turn that there is already count.

    The mean of the corrections is taken away, so that a step of one of five moves it by 4 / 5.
    """
    layer, moment, weights = layer_of(0.1), moment_of(degree, with_axes), weights_of()
    (found,) = torch.autograd.grad(loss_of(layer, moment, weights), layer.values)
    assert torch.equal(found[[0, 1, 3, 4]], torch.zeros(4, 6, dtype=torch.float64))
    camera, time = VIEWS[2]
    applied = layer.weighed(layer.corrections(), camera, time)
    assert applied is not None

    def value(step: Tensor) -> float:
        unit = torch.tensor([1.0] * 3 + [layer.bound] * 3, dtype=torch.float64)
        seen = corrected(camera, (applied + step * unit).numpy())
        with torch.no_grad():
            frame = load_engine("reference").rasterize(
                moment, seen, torch.ones(3, dtype=torch.float64)
            )
        return float((frame.rgb * weights).sum())

    eps = 1e-6
    steps = eps * torch.eye(6, dtype=torch.float64)
    expected = [(value(step) - value(-step)) / (2 * eps) for step in steps]
    torch.testing.assert_close(found[2], torch.tensor(expected).double(), rtol=2e-5, atol=2e-6)


@pytest.mark.parametrize("with_axes", [False, True])
def test_the_engine_of_the_cpu_gives_the_same(with_axes: bool) -> None:
    exact = layer_of()
    loss = loss_of(exact, moment_of(2, with_axes), weights_of())
    (expected,) = torch.autograd.grad(loss, exact.values)
    layer, single = layer_of(dtype=torch.float32), torch.float32
    loss = loss_of(layer, moment_of(2, with_axes, single), weights_of(single), "cpu")
    (found,) = torch.autograd.grad(loss, layer.values)
    torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("with_axes", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gradients_by_the_focal_length_are_those_of_differences(
    degree: int, with_axes: bool
) -> None:
    layer, moment, weights = focal_layer(), moment_of(degree, with_axes), weights_of()
    assert layer.log_focals is not None
    (found,) = torch.autograd.grad(loss_of(layer, moment, weights), layer.log_focals)
    start, eps = float(layer.log_focals), 1e-6

    def value(by: float) -> float:
        layer.parameters()[-1].set_values(torch.tensor([start + by], dtype=torch.float64))
        with torch.no_grad():
            return float(loss_of(layer, moment, weights))

    expected = (value(eps) - value(-eps)) / (2 * eps)
    torch.testing.assert_close(float(found), expected, rtol=2e-5, atol=2e-6)


def test_the_engine_of_the_cpu_gives_the_same_of_the_focal_length() -> None:
    exact, single = focal_layer(), torch.float32
    assert exact.log_focals is not None
    loss = loss_of(exact, moment_of(2, False), weights_of())
    expected = torch.autograd.grad(loss, [exact.log_focals, exact.values])
    layer = focal_layer(single)
    assert layer.log_focals is not None
    loss = loss_of(layer, moment_of(2, False, single), weights_of(single), "cpu")
    found = torch.autograd.grad(loss, [layer.log_focals, layer.values])
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.double(), other, rtol=1e-3, atol=1e-4)


def test_what_is_drawn_and_its_other_gradients_stay_with_a_focal_length() -> None:
    layer, moment, weights = focal_layer(), moment_of(1, False), weights_of()
    own = [*moment.splats.tensors().values()]
    drawn = loss_of(layer, moment, weights)
    found = torch.autograd.grad(drawn, own)
    layer.advance(0.0)
    plain = loss_of(layer, moment, weights)
    torch.testing.assert_close(drawn, plain)
    for one, other in zip(found, torch.autograd.grad(plain, own), strict=True):
        torch.testing.assert_close(one, other)


def test_views_of_the_path_share_a_focal_length_and_strange_ones_have_none() -> None:
    layer = focal_layer()
    camera, time = VIEWS[1]
    placed = layer.place(camera, time)
    assert (placed.fx, placed.fy) == pytest.approx((1.05 * camera.fx, 1.05 * camera.fy))
    between = layer.place(corrected(camera, np.full(6, 0.01)), 0.3)
    assert between.fx == pytest.approx(1.05 * camera.fx)
    far = replace(camera, world_to_camera=look_at(np.array([-3.0, 0.0, 1.0]), np.zeros(3), UP))
    assert layer.place(far, 0.5) is far
    assert layer.tell_views(VIEWS)["focal_factors"] == pytest.approx([1.05])


def test_each_fixed_camera_has_a_focal_length_of_its_own() -> None:
    layer = started_layer("cameras", focal=True)
    assert isinstance(layer, Cameras) and layer.log_focals is not None
    rig = [(camera, time) for camera, _ in VIEWS[:3] for time in (0.0, 0.5, 1.0)]
    layer.begin_with(rig)
    assert layer.log_focals.shape == (3,)
    layer.parameters()[-1].set_values(torch.tensor([0.1, 0.0, -0.1]))
    found = [layer.place(camera, 0.2).fx / camera.fx for camera, _ in VIEWS[:4]]
    assert found == pytest.approx([math.exp(0.1), 1.0, math.exp(-0.1), 1.0])


def test_what_is_drawn_and_its_other_gradients_stay() -> None:
    layer, moment, weights = layer_of(), moment_of(1, False), weights_of()
    camera, time = VIEWS[2]
    seen = layer.as_seen(moment, Instant(time, view=camera))
    for name, tensor in moment.tensors().items():
        assert torch.equal(seen.tensors()[name], tensor)
    own = [*moment.splats.tensors().values()]
    found = torch.autograd.grad(loss_of(layer, moment, weights), own)
    layer.advance(0.0)
    assert layer.as_seen(moment, Instant(time, view=camera)) is moment
    expected = torch.autograd.grad(loss_of(layer, moment, weights), own)
    for one, other in zip(found, expected, strict=True):
        assert torch.equal(one, other)


def test_a_correction_turns_a_camera_about_its_place_and_shifts_it() -> None:
    camera, _ = VIEWS[1]
    turn, shift = np.array([0.0, 0.0, 0.3]), np.array([0.1, -0.2, 0.05])
    found = corrected(camera, np.concatenate([turn, shift]))
    np.testing.assert_allclose(found.centre, camera.centre + shift, atol=1e-12)
    ahead, then = camera.rotation[2], found.rotation[2]
    c, s = np.cos(0.3), np.sin(0.3)
    np.testing.assert_allclose(then, [c * ahead[0] - s * ahead[1], s * ahead[0] + c * ahead[1],
                                      ahead[2]], atol=1e-12)  # fmt: skip
    assert (found.fx, found.width) == (camera.fx, camera.width)


def test_what_all_cameras_do_together_is_left_to_the_splats() -> None:
    layer = layer_of()
    expected = layer.corrections()
    torch.testing.assert_close(expected.mean(dim=0), torch.zeros(6).double(), rtol=0, atol=1e-12)
    centres = torch.tensor(np.stack([camera.centre for camera, _ in VIEWS]))
    arms = centres - centres.mean(dim=0)
    common = torch.cat([torch.full((5, 3), 0.03).double(), 0.2 * arms + 0.1], dim=1)
    layer.parameters()[0].set_values(layer.values.detach() + common)
    torch.testing.assert_close(layer.corrections(), expected, rtol=0, atol=1e-12)


def test_free_cameras_and_strange_views_have_none() -> None:
    layer, moment = layer_of(), moment_of(0, False)
    camera, _ = VIEWS[2]
    assert layer.as_seen(moment, Instant(0.5)) is moment
    far = replace(camera, world_to_camera=look_at(np.array([-3.0, 0.0, 1.0]), np.zeros(3), UP))
    assert layer.place(far, 0.5) is far


def test_the_penalty_is_the_weighted_mean_square() -> None:
    layer = layer_of(weight=0.5)
    moment = moment_of(0, False)
    found = layer.penalty(moment, Instant(0.0), generator())
    assert found is not None
    torch.testing.assert_close(found, 0.5 * layer.values.square().sum(dim=1).mean())
    layer.advance(0.01)
    assert layer.penalty(moment, Instant(0.0), generator()) is None, "it does not learn yet"


def test_a_report_says_how_views_are_drawn() -> None:
    layer = layer_of()
    between, far = (corrected(VIEWS[2][0], np.full(6, by)) for by in (0.01, 2.0))
    told = layer.tell_views([VIEWS[0], (between, 0.55), (far, 0.5)])
    counts = {key: told[key] for key in ("own", "of_neighbours", "none")}
    assert counts == {"own": 1, "of_neighbours": 1, "none": 1} and told["per"] == "picture"


def test_a_file_has_a_correction_for_every_view() -> None:
    file = {name: t.detach().clone() for name, t in layer_of(dtype=torch.float32).tensors().items()}
    layer = started_layer("cameras")
    layer.restore(file, 1)
    assert isinstance(layer, Cameras) and layer.rows.weights(*VIEWS[3]) == ((3, 1.0),)
    with_focal = {n: t.detach().clone() for n, t in focal_layer(torch.float32).tensors().items()}
    other = started_layer("cameras", focal=True)
    other.restore(with_focal, 1)
    assert other.place(*VIEWS[3]).fx == pytest.approx(1.05 * VIEWS[3][0].fx)
    with pytest.raises(ValueError, match="nothing for 'log_focals'"):
        other.restore(file, 1)
    with pytest.raises(ValueError, match=r"focal lengths of shape \(2,\), not \(1,\)"):
        other.restore(with_focal | {"log_focals": torch.zeros(2)}, 1)
    for broken in (
        {"values": torch.zeros(4, 6)},
        {"values": torch.zeros(5, 4)},
        {"numbers": torch.arange(4)},
        {"poses": torch.zeros(5, 3, 4).double()},
    ):
        with pytest.raises(ValueError, match=r"corrections of cameras|rows of"):
            started_layer("cameras").restore(file | broken, 1)


@pytest.mark.parametrize(("options", "message"), [
    ({"since": 1.5}, "since is 1.5; allowed: a progress from 0 to 1"),
    ({"rate": (0.0, 1e-5)}, r"rate is \[0.0, 1e-05\]; allowed: \[start, end\], both above 0"),
    ({"weight": -1.0}, "weight is -1.0; allowed: 0 or more"),
    ({"focal_rate": (1e-3, 0.0)}, r"focal_rate is \[0.001, 0.0\]; allowed: \[start, end\], both"),
    ({"per": "rig"}, "per is \"rig\"; allowed: 'auto' or 'frame' or 'camera'"),
])  # fmt: skip
def test_options_out_of_range_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        started_layer("cameras", **options)
