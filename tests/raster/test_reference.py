"""The reference engine against closed forms and finite differences, in float64."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from raster_scenes import (
    Case,
    at_pixels,
    camera,
    case,
    draw,
    pixel_weights,
    poisoned,
    poisoned_moment,
    splats,
)
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0, SH_C1, covariance, quat_to_rotmat
from gsdmsr_cli.ground.splatting_constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    DILATION,
    FRUSTUM_MARGIN,
    NEAR,
    TRANSMITTANCE_STOP,
)
from gsdmsr_cli.raster import engine_names, reference
from gsdmsr_cli.scene.camera import Camera

AHEAD = Camera(np.eye(4), 50.0, 50.0, 16.5, 16.5, 33, 33)
CENTRE = (16, 16)
BACKGROUND = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)


def balls(
    depths: list[float],
    opacities: list[float],
    colours: list[list[float]] | None = None,
    scale: float = 0.1,
) -> Splats:
    """Isotropic splats on the optical axis of AHEAD, white unless said."""
    n = len(depths)
    colour = torch.ones(n, 3) if colours is None else torch.tensor(colours)
    zeros = torch.zeros(n, dtype=torch.float64)
    return Splats(
        means=torch.stack([zeros, zeros, torch.tensor(depths, dtype=torch.float64)], -1),
        quats=torch.tensor([[2.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(scale), dtype=torch.float64),
        logit_opacities=torch.tensor(opacities, dtype=torch.float64).logit(),
        sh=((colour.double() - 0.5) / SH_C0).unsqueeze(1),
    )


def rasterize(of: Splats | Moment, view: Camera = AHEAD) -> Frame:
    moment = Moment(of) if isinstance(of, Splats) else of
    return reference.rasterize(moment, view, BACKGROUND, with_depth=True)


def falloff(depth: float, scale: float = 0.1) -> Tensor:
    """(33, 33) closed form of a unit ball on the axis of AHEAD."""
    offset = torch.arange(33, dtype=torch.float64) - 16
    variance = (50 * scale / depth) ** 2 + DILATION
    return (-0.5 * (offset**2 + offset[:, None] ** 2) / variance).exp()


def test_one_splat_is_a_gaussian_cut_off_over_the_background() -> None:
    colour = [0.9, 0.4, 0.6]
    frame = rasterize(balls([4.0], [0.8], [colour]))
    alpha = 0.8 * falloff(4.0)
    alpha = alpha.where(alpha >= ALPHA_MIN, 0.0)
    assert (alpha == 0).any()
    torch.testing.assert_close(frame.alpha, alpha)
    rgb = alpha[..., None] * torch.tensor(colour) + (1 - alpha[..., None]) * BACKGROUND
    torch.testing.assert_close(frame.rgb, rgb, atol=1e-7, rtol=0)
    torch.testing.assert_close(frame.depth, 4 * alpha)
    torch.testing.assert_close(frame.means2d, torch.tensor([[16.5, 16.5]]).double())
    reach = math.sqrt(2 * math.log(255 * 0.8) * ((50 * 0.1 / 4) ** 2 + DILATION))
    assert frame.radii.tolist() == [pytest.approx(reach)]


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_two_splats_blend_front_to_back(order: list[int]) -> None:
    pair = balls([5.0, 3.0], [0.6, 0.7], [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    frame = rasterize(pair.take(torch.tensor(order)))
    far, near = 0.6 * falloff(5.0), 0.7 * falloff(3.0)
    far, near = far.where(far >= ALPHA_MIN, 0.0), near.where(near >= ALPHA_MIN, 0.0)
    through = (1 - near) * far
    left = (1 - near) * (1 - far)
    assert frame.depth is not None
    torch.testing.assert_close(frame.rgb[..., 0], through + left * 0.1)
    torch.testing.assert_close(frame.rgb[..., 1], left * 0.2)
    torch.testing.assert_close(frame.rgb[..., 2], near + left * 0.3)
    torch.testing.assert_close(frame.alpha, 1 - left)
    torch.testing.assert_close(frame.depth, 3 * near + 5 * through)


def test_equal_depths_blend_in_order_of_rows() -> None:
    frame = rasterize(balls([4.0, 4.0], [0.9, 0.9], [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    assert frame.rgb[CENTRE][0] > frame.rgb[CENTRE][1]


def test_saturated_pixel_passes_no_gradient_to_the_shape() -> None:
    solid = balls([4.0], [1 - 1e-12]).map(lambda t: t.requires_grad_())
    frame = rasterize(solid)
    assert frame.alpha[CENTRE].item() == pytest.approx(ALPHA_MAX)
    frame.rgb[CENTRE].sum().backward()
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        assert not solid.tensors()[name].grad.any(), name
    torch.testing.assert_close(solid.sh.grad, torch.full((1, 1, 3), ALPHA_MAX * SH_C0).double())


def test_a_pixel_stops_after_its_transmittance_falls_below_the_stop() -> None:
    row = balls([3.0, 3.5, 4.0, 4.5, 5.0, 5.5], [0.95] * 6).map(lambda t: t.requires_grad_())
    frame = rasterize(row)
    assert 0.05**3 > TRANSMITTANCE_STOP > 0.05**4
    assert frame.alpha[CENTRE].item() == pytest.approx(1 - 0.05**4, abs=1e-12)
    frame.rgb[CENTRE].sum().backward()
    assert (row.sh.grad.flatten(1).sum(-1) > 0).tolist() == [True] * 4 + [False] * 2


@pytest.mark.parametrize(
    ("depth", "opacity"), [(-4.0, 0.9), (0.0, 0.9), (NEAR, 0.9), (4.0, 0.99 * ALPHA_MIN)]
)
def test_splats_out_of_sight_are_not_drawn(depth: float, opacity: float) -> None:
    unseen = balls([depth], [opacity]).map(lambda t: t.requires_grad_())
    frame = rasterize(unseen)
    assert not frame.alpha.any()
    assert not frame.radii.any()
    frame.rgb.sum().backward()
    for name, tensor in unseen.tensors().items():
        assert not tensor.grad.any(), name


def test_just_beyond_the_near_plane_is_drawn() -> None:
    assert rasterize(balls([NEAR + 1e-9], [0.9], scale=1e-3)).alpha[CENTRE] > 0.5


@pytest.mark.parametrize(("beside", "drawn"), [(0.99, True), (1.01, False)])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_splat_is_drawn_if_its_box_touches_the_image(
    beside: float, drawn: bool, axis: int, side: int
) -> None:
    tiny = balls([4.0], [0.8], scale=1e-5)  # its screen variance is the dilation
    reach = math.sqrt(2 * math.log(255 * 0.8) * DILATION)
    tiny.means[0, axis] = side * (16.5 + beside * reach) * 4.0 / 50
    assert (rasterize(tiny).radii > 0).tolist() == [drawn]


def test_zero_splats_give_the_background() -> None:
    frame = rasterize(balls([], []))
    assert torch.equal(frame.rgb, BACKGROUND.expand(33, 33, 3))
    assert not frame.alpha.any()
    assert frame.radii.shape == (0,)
    assert frame.means2d.shape == (0, 2)


def conic_of(picture: Tensor) -> Tensor:
    """(2, 2) inverse covariance of a single splat's alpha picture, by least squares."""
    y, x = torch.nonzero(picture > 0, as_tuple=True)
    columns = torch.stack([x * x, x * y, y * y, x, y, torch.ones_like(x)], -1).double()
    xx, xy, yy = torch.linalg.lstsq(columns, picture[y, x].log()).solution[:3]
    return -torch.stack([torch.stack([2 * xx, xy]), torch.stack([xy, 2 * yy])])


def projection_jacobian(view: Camera, point: np.ndarray) -> np.ndarray:
    """(2, 3) Jacobian of the projection of a world point, by central differences."""

    def project(world: np.ndarray) -> np.ndarray:
        x, y, z = view.rotation @ world + view.translation
        return np.array([view.fx * x / z + view.cx, view.fy * y / z + view.cy])

    steps = 1e-6 * np.eye(3)
    return np.stack([(project(point + s) - project(point - s)) / 2e-6 for s in steps], -1)


def test_the_ellipse_is_the_projected_covariance() -> None:
    view = camera(64, 48, fx=60.0, fy=75.0, cx=27.0, cy=29.0)
    one = splats(1, degree=0, seed=2, size=0.25, logit=(2.0, 0.0)).map(torch.Tensor.double)
    one = replace(one, means=torch.tensor([[0.25, -0.3, 0.2]], dtype=torch.float64))
    frame = rasterize(one, view)
    jacobian = torch.from_numpy(projection_jacobian(view, one.means[0].numpy()))
    expected = jacobian @ covariance(one.quats, one.log_scales)[0] @ jacobian.T
    expected = expected + DILATION * torch.eye(2)
    torch.testing.assert_close(conic_of(frame.alpha).inverse(), expected, atol=1e-5, rtol=1e-5)
    reach = 2 * math.log(255 * one.logit_opacities.sigmoid().item())
    assert frame.radii[0].item() == pytest.approx(math.sqrt(reach * expected.diag().max().item()))


def test_the_ellipse_of_axes_is_that_of_their_products() -> None:
    """A sheared A, which is no rotation times scales."""
    view = camera(64, 48, fx=60.0, fy=75.0, cx=27.0, cy=29.0)
    one = splats(1, degree=0, seed=2, logit=(2.0, 0.0)).map(torch.Tensor.double)
    one = replace(one, means=torch.tensor([[0.25, -0.3, 0.2]], dtype=torch.float64))
    axes = torch.tensor([[0.3, 0.2, -0.1], [0.0, 0.25, 0.3], [0.1, 0.0, 0.2]]).double()
    frame = rasterize(Moment(one, axes[None]), view)
    jacobian = torch.from_numpy(projection_jacobian(view, one.means[0].numpy()))
    expected = jacobian @ axes @ axes.T @ jacobian.T + DILATION * torch.eye(2)
    torch.testing.assert_close(conic_of(frame.alpha).inverse(), expected, atol=1e-5, rtol=1e-5)


def assert_same_frame(found: Frame, expected: Frame) -> None:
    for name, image in vars(expected).items():
        if image is not None:
            torch.testing.assert_close(getattr(found, name), image, atol=1e-12, rtol=1e-9)


def test_axes_along_the_world_are_scales() -> None:
    sizes = torch.tensor([[0.3, 0.1, 0.2]], dtype=torch.float64)
    one = replace(balls([4.0], [0.8]), log_scales=sizes.log())
    found = rasterize(Moment(balls([4.0], [0.8]), torch.diag_embed(sizes)))
    assert_same_frame(found, rasterize(one))
    variance = (50 * 0.3 / 4) ** 2 + DILATION, (50 * 0.1 / 4) ** 2 + DILATION
    offsets = torch.arange(33, dtype=torch.float64) - 16
    alpha = 0.8 * (-0.5 * (offsets**2 / variance[0] + offsets[:, None] ** 2 / variance[1])).exp()
    torch.testing.assert_close(found.alpha, alpha.where(alpha >= ALPHA_MIN, 0.0))


def test_axes_are_rotations_times_scales_and_turn_freely_from_the_right() -> None:
    some, view = splats(20, seed=26).map(torch.Tensor.double), camera(30, 20)
    scaled = quat_to_rotmat(some.quats) * some.log_scales.exp().unsqueeze(1)
    rng = torch.Generator().manual_seed(27)
    turns = quat_to_rotmat(torch.randn(20, 4, generator=rng, dtype=torch.float64))
    expected = rasterize(some, view)
    assert expected.alpha.max() > 0.5
    nothing = {n: torch.full_like(getattr(some, n), math.nan) for n in ("quats", "log_scales")}
    for axes in (scaled, scaled @ turns, -scaled):
        assert_same_frame(rasterize(Moment(replace(some, **nothing), axes), view), expected)


def test_axes_of_no_length_leave_the_dilation() -> None:
    found = rasterize(Moment(balls([4.0], [0.8]), torch.zeros(1, 3, 3, dtype=torch.float64)))
    alpha = 0.8 * falloff(4.0, 0.0)
    torch.testing.assert_close(found.alpha, alpha.where(alpha >= ALPHA_MIN, 0.0))


def test_features_blend_as_colours_do_without_background_and_bounds() -> None:
    pair = balls([5.0, 3.0], [0.6, 0.7])
    features = torch.tensor([[7.0, 0.5], [-4.0, 0.0]], dtype=torch.float64)
    frame = rasterize(Moment(pair, features=features))
    far, near = 0.6 * falloff(5.0), 0.7 * falloff(3.0)
    far, near = far.where(far >= ALPHA_MIN, 0.0), near.where(near >= ALPHA_MIN, 0.0)
    through = (1 - near) * far
    assert frame.features is not None
    torch.testing.assert_close(frame.features[..., 0], 7 * through - 4 * near)
    torch.testing.assert_close(frame.features[..., 1], 0.5 * through)
    assert frame.features.min() < 0
    assert_same_frame(frame, rasterize(pair))


def test_without_features_there_are_none() -> None:
    assert rasterize(balls([4.0], [0.8])).features is None
    nobody = Moment(balls([], []), features=torch.zeros(0, 4, dtype=torch.float64))
    found = rasterize(nobody).features
    assert found is not None and found.shape == (33, 33, 4) and not found.any()


def test_beyond_the_margin_the_jacobian_is_that_of_the_margin() -> None:
    """A ball outside the margin has the ellipse of one on the margin."""
    slope = FRUSTUM_MARGIN * 16.5 / 50
    outer = balls([2.0], [0.9], scale=0.5)
    outer.means[0, 0] = 2.0 * (slope + 0.1)
    inside = balls([2.0], [0.9], scale=0.5)
    inside.means[0, 0] = 2.0 * slope
    ellipses = [conic_of(rasterize(ball).alpha) for ball in (outer, inside)]
    torch.testing.assert_close(ellipses[0], ellipses[1], atol=1e-9, rtol=1e-6)


def test_colour_follows_the_direction_from_camera_to_splat() -> None:
    ball = balls([4.0], [0.9])
    sh = torch.zeros(1, 4, 3, dtype=torch.float64)
    sh[0, 1:] = 0.3 * torch.eye(3)  # red by -y, green by z, blue by -x
    ball = replace(ball, sh=sh, means=torch.tensor([[0.4, -0.2, 4.0]], dtype=torch.float64))
    x, y, z = (ball.means[0] / ball.means[0].norm()).tolist()
    frame = rasterize(ball)
    seen = (frame.rgb - (1 - frame.alpha[..., None]) * BACKGROUND) / frame.alpha[..., None]
    column, row = (frame.means2d[0] - 0.5).round().int().tolist()
    expected = [0.5 - 0.3 * SH_C1 * y, 0.5 + 0.3 * SH_C1 * z, 0.5 - 0.3 * SH_C1 * x]
    assert seen[row, column].tolist() == pytest.approx(expected)


def test_active_degree_uses_the_first_coefficients() -> None:
    full = splats(20, degree=3).map(torch.Tensor.double)
    low = replace(full, sh=full.sh[:, :4])
    view = camera(24, 20)
    found = reference.rasterize(Moment(full), view, BACKGROUND, sh_degree=1)
    assert torch.equal(found.rgb, reference.rasterize(Moment(low), view, BACKGROUND).rgb)
    assert found.depth is None
    assert torch.equal(
        reference.rasterize(Moment(low), view, BACKGROUND, sh_degree=3).rgb, found.rgb
    )


def test_colours_are_not_negative() -> None:
    frame = rasterize(balls([4.0], [0.9], [[-3.0, 0.5, 1.0]]))
    assert frame.rgb[CENTRE][0].item() == pytest.approx(0.1 * 0.1)


@pytest.mark.parametrize("poisoned", [poisoned, poisoned_moment])
def test_rows_that_are_not_finite_are_as_if_absent(
    poisoned: Callable[[], tuple[Case, Case, Tensor]],
) -> None:
    sick, healthy, finite = poisoned()
    weights = pixel_weights(sick)
    found = draw(reference, sick, weights, "cpu", torch.float64)
    expected = draw(reference, healthy, weights, "cpu", torch.float64)
    assert torch.equal(found.frame.rgb, expected.frame.rgb)
    for name, gradient in found.gradients.items():
        assert gradient.isfinite().all(), name
        torch.testing.assert_close(gradient[finite], expected.gradients[name])
    assert set(found.frame.radii.nonzero().flatten().tolist()) <= set(finite.tolist())


def test_chunks_do_not_change_the_result(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = case("17x33")
    weights = pixel_weights(scene)
    whole = draw(reference, scene, weights, "cpu", torch.float64)
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 1000)
    chunked = draw(reference, scene, weights, "cpu", torch.float64)
    torch.testing.assert_close(chunked.frame.rgb, whole.frame.rgb)
    torch.testing.assert_close(chunked.gradients, whole.gradients)


@pytest.mark.parametrize("degree", [1, 3])
def test_gradients_match_finite_differences(degree: int) -> None:
    few = splats(5, degree=degree, seed=21, size=0.4).map(torch.Tensor.double)
    view = camera(6, 5, fx=7.0, fy=6.0, cx=2.5)
    beyond_the_margin = torch.tensor([[-2.0, 2.0]])
    few.means[0] = at_pixels(view, beyond_the_margin, torch.tensor([3.0]))[0]
    limit = FRUSTUM_MARGIN * np.array([view.width / view.fx, view.height / view.fy]) / 2
    x, y, z = view.rotation @ few.means[0].numpy() + view.translation
    assert (np.abs([x / z, y / z]) > limit).any()
    assert (rasterize(few, view).radii > 0).all()

    def pictures(*tensors: Tensor) -> tuple[Tensor, ...]:
        frame = rasterize(Splats(*tensors), view)
        assert frame.depth is not None
        return frame.rgb, frame.alpha, frame.depth

    leaves = [tensor.requires_grad_() for tensor in few.tensors().values()]
    assert torch.autograd.gradcheck(pictures, leaves)


def test_gradients_of_axes_and_features_match_finite_differences() -> None:
    few = splats(4, seed=28, size=0.4).map(torch.Tensor.double)
    view = camera(6, 5, fx=7.0, fy=6.0, cx=2.5)
    rng = torch.Generator().manual_seed(29)
    axes = 0.4 * torch.randn(4, 3, 3, generator=rng, dtype=torch.float64)
    features = torch.randn(4, 2, generator=rng, dtype=torch.float64)
    assert (rasterize(Moment(few, axes, features), view).radii > 0).all()

    def pictures(means: Tensor, logits: Tensor, *further: Tensor) -> tuple[Tensor, ...]:
        moved = replace(few, means=means, logit_opacities=logits)
        frame = rasterize(Moment(moved, *further), view)
        assert frame.depth is not None and frame.features is not None
        return frame.rgb, frame.alpha, frame.depth, frame.features

    leaves = [t.requires_grad_() for t in (few.means, few.logit_opacities, axes, features)]
    assert torch.autograd.gradcheck(pictures, leaves)


def test_gradient_of_screen_means_moves_the_picture() -> None:
    """The gradient of means2d is that of shifting the picture by the principal point."""
    ball = balls([4.0], [0.8]).map(lambda t: t.requires_grad_())
    frame = rasterize(ball)
    frame.means2d.retain_grad()
    ramp = torch.linspace(0, 1, 33, dtype=torch.float64)
    (frame.alpha * ramp).sum().backward()

    def shifted(by: float) -> float:
        moved = rasterize(ball, replace(AHEAD, cx=16.5 + by)).alpha
        return float((moved * ramp).sum().detach())

    expected = (shifted(1e-5) - shifted(-1e-5)) / 2e-5
    assert frame.means2d.grad[0, 0].item() == pytest.approx(expected, rel=1e-6)
    assert expected > 0


def test_every_device_has_a_reason_or_draws() -> None:
    assert "reference" in engine_names()
    assert reference.unavailable("cpu") is None
    assert (reference.unavailable("cuda") is None) == torch.cuda.is_available()
