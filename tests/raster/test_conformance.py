"""Every engine is held to the float64 reference, picture and gradient, at awkward sizes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import pytest
import torch
from raster_scenes import (
    CASES,
    WITH_FEATURES,
    Case,
    Drawing,
    ambiguous,
    case,
    draw,
    overflowing,
    pixel_weights,
    poisoned,
    poisoned_moment,
)
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import ALPHA_MAX, TRANSMITTANCE_STOP, tile_grid
from gsdmsr_cli.raster import (
    Comparing,
    Comparison,
    Engine,
    engine_names,
    load_engine,
    reference,
)
from gsdmsr_cli.training.gradients.compare import judge

FORWARD = 1e-4  # largest error of a pixel; of depth, relative to the farthest splat
BACKWARD = 1e-3  # error of a gradient in the L2 norm, relative
MOST_AMBIGUOUS = 0.02  # share of pixels too close to a threshold to be compared

Placed = tuple[Engine, str]


ON_THE_CPU = "cuda, its kernels on the CPU"
MEASURES = [Measure(0.0), Measure(0.2), Measure(0.0, 0.2)]
ENGINES = [name for name in engine_names() if name != "reference"] + [ON_THE_CPU]


@pytest.fixture(scope="module", params=ENGINES)
def placed(request: pytest.FixtureRequest) -> Placed:
    """An engine and the device it draws on."""
    if request.param == ON_THE_CPU:
        request.getfixturevalue("kernels_on_the_cpu")
        return load_engine("cuda"), "cpu"
    engine = load_engine(request.param)
    reasons = {device: engine.unavailable(device) for device in ("cpu", "cuda")}
    for device, reason in reasons.items():
        if reason is None:
            return engine, device
    pytest.skip(f"engine {request.param} cannot run: {reasons}")


@cache
def drawings(placed: Placed, name: str) -> tuple[Drawing, Drawing]:
    """The case as the engine draws it in float32 and as the reference does in float64."""
    engine, device = placed
    weights = pixel_weights(case(name))
    found = draw(engine, case(name), weights, device, torch.float32)
    return found, draw(reference, case(name), weights, "cpu", torch.float64)


def drawing_that_never_stops(name: str) -> Drawing:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reference, "TRANSMITTANCE_STOP", 0.0)
        return draw(reference, case(name), pixel_weights(case(name)), "cpu", torch.float64)


def farthest(of: Case, radii: Tensor) -> float:
    """Greatest camera z of the drawn splats, not below 1: the scale of the depth image."""
    view, means = of.camera, of.splats.means[radii > 0].double()
    depths = means @ torch.tensor(view.rotation[2]) + view.translation[2]
    return max([1.0, *depths.tolist()])


@pytest.mark.parametrize("name", CASES | WITH_FEATURES)
def test_pictures_match_the_reference(placed: Placed, name: str) -> None:
    found, exact = drawings(placed, name)
    compared = ~ambiguous(case(name))
    assert compared.double().mean() >= 1 - MOST_AMBIGUOUS
    assert found.frame.rgb.dtype == torch.float32
    absent = {"depth": not case(name).with_depth, "features": case(name).features is None}
    for image in ("rgb", "alpha", "depth", "features"):
        ours, truth = getattr(found.frame, image), getattr(exact.frame, image)
        assert (ours is None) == (truth is None) == absent.get(image, False)
        if truth is not None:
            assert ours.shape == truth.shape
            scale = farthest(case(name), exact.frame.radii) if image == "depth" else 1.0
            assert (ours - truth)[compared].abs().max() <= FORWARD * scale, image


@pytest.mark.parametrize("name", CASES | WITH_FEATURES)
def test_gradients_match_the_reference(placed: Placed, name: str) -> None:
    found, exact = drawings(placed, name)
    right = [exact, drawing_that_never_stops(name)] if case(name).past_stop else [exact]
    for tensor, ours in found.gradients.items():
        truths = [drawing.gradients[tensor] for drawing in right]
        assert ours.shape == truths[0].shape
        assert any((ours - truth).norm() <= BACKWARD * truth.norm() for truth in truths), tensor


@pytest.mark.parametrize("name", CASES | WITH_FEATURES)
def test_radii_and_screen_means_match_the_reference(placed: Placed, name: str) -> None:
    found, exact = (drawing.frame for drawing in drawings(placed, name))
    # Engines may round a radius up, and drop a splat that touches no pixel centre.
    assert not found.radii[exact.radii == 0].any()
    drawn = found.radii > 0
    assert drawn.sum() >= 0.9 * (exact.radii > 0).sum()
    excess = found.radii[drawn] - exact.radii[drawn]
    tolerance = 1e-3 * (1 + exact.radii[drawn])
    assert ((excess > -tolerance) & (excess < 1 + tolerance)).all()
    torch.testing.assert_close(
        found.means2d[drawn].double(), exact.means2d[drawn], atol=1e-3, rtol=1e-5
    )


def test_cases_reach_the_places_they_are_named_after() -> None:
    drawn = {
        name: draw(reference, case(name), pixel_weights(case(name)), "cpu", torch.float64)
        for name in CASES
    }
    for name in CASES.keys() - {n for n in CASES if n.startswith(("zero splats", "none in view"))}:
        assert drawn[name].frame.alpha.max() > 0.1, name
        for tensor, gradient in drawn[name].gradients.items():
            assert gradient.norm() > 0, (name, tensor)

    def count(name: str) -> int:
        return int((drawn[name].frame.radii > 0).sum())

    assert count("more than a batch in a tile") > 600
    assert count("more than a batch in a tile, opaque") > 600
    assert drawn["more than a batch in a tile, opaque"].frame.alpha.max() > 1 - TRANSMITTANCE_STOP
    assert count("behind and at the near plane") == 20
    assert count("outside the margin") == 5
    assert count("none in view") == 0
    assert drawn["saturated"].frame.alpha.max() > ALPHA_MAX


@pytest.mark.parametrize("poisoned", [poisoned, poisoned_moment])
def test_rows_that_are_not_finite_are_as_if_absent(
    placed: Placed, poisoned: Callable[[], tuple[Case, Case, Tensor]]
) -> None:
    sick, healthy, finite = poisoned()
    weights = pixel_weights(sick)
    found = draw(placed[0], sick, weights, placed[1], torch.float32)
    expected = draw(placed[0], healthy, weights, placed[1], torch.float32)
    for image in ("rgb", "alpha", "depth"):
        torch.testing.assert_close(
            getattr(found.frame, image), getattr(expected.frame, image), atol=1e-6, rtol=0
        )
    absent = torch.ones(len(sick.splats), dtype=torch.bool)
    absent[finite] = False
    assert not found.frame.radii[absent].any()
    if sick.features is not None:
        assert torch.equal(found.frame.features, expected.frame.features)
    for name, gradient in found.gradients.items():
        assert not gradient[absent].any(), name
        torch.testing.assert_close(gradient[finite], expected.gradients[name])


def test_quats_and_scales_beside_axes_are_not_in_the_graph(placed: Placed) -> None:
    engine, device = placed
    of = case("17x33, axes")
    leaves = of.moment.map(lambda t: t.to(device, copy=True).requires_grad_())
    engine.rasterize(leaves, of.camera, of.background.to(device)).rgb.sum().backward()
    assert leaves.axes is not None and leaves.axes.grad is not None
    assert leaves.splats.quats.grad is None and leaves.splats.log_scales.grad is None


def test_axes_that_overflow_spoil_neither_picture_nor_gradients(placed: Placed) -> None:
    of = case("17x33, axes")
    assert of.axes is not None
    axes = of.axes.clone()
    for row, size in enumerate((1e6, 1e12, 1e20, 3e38, 1e-12, 1e-38, 0.0)):
        axes[row] = axes[row].sign() * size
    scene = replace(of, axes=axes)
    found = draw(placed[0], scene, torch.ones(33, 17, 5), placed[1], torch.float32)
    for image in (found.frame.rgb, found.frame.alpha, found.frame.depth, found.frame.means2d):
        assert image is not None and image.isfinite().all()
    for name, gradient in found.gradients.items():
        assert gradient.isfinite().all(), name
    assert (found.frame.radii > 0).sum() > 10


def test_what_was_drawn_carries_gradients_and_radii_do_not(placed: Placed) -> None:
    of = case("17x33, 1 features").splats.map(
        lambda t: t.detach().float().to(placed[1]).requires_grad_()
    )
    frame = placed[0].rasterize(Moment(of), case("17x33, 1 features").camera, torch.ones(3))
    assert frame.rgb.requires_grad and frame.means2d.requires_grad
    assert not frame.radii.requires_grad


def test_features_are_not_compared_in_one_go(placed: Placed) -> None:
    with pytest.raises(ValueError, match="drawn by rasterize and compared afterwards"):
        compared(placed, "17x33, 1 features", Measure(0.2))


def test_values_that_overflow_spoil_neither_picture_nor_gradients(placed: Placed) -> None:
    scene = overflowing()
    found = draw(placed[0], scene, torch.ones(18, 20, 5), placed[1], torch.float32)
    for image in vars(found.frame).values():
        assert image is None or image.isfinite().all()
    for name, gradient in found.gradients.items():
        assert gradient.isfinite().all(), name
    assert (found.frame.radii > 0).sum() > 10


def test_zero_splats_give_the_background(placed: Placed) -> None:
    frame = drawings(placed, "zero splats")[0].frame
    assert torch.equal(frame.rgb, case("zero splats").background.expand_as(frame.rgb))
    assert not frame.alpha.any()


def compared(
    placed: Placed, name: str, measure: Measure, chosen: bool = False
) -> tuple[list[Tensor], list[Tensor]]:
    """Loss, gradients, screen gradients and tile errors by ``compare``, and by drawing first.

    Args:
        measure: how pictures are compared.
        chosen: weigh the tiles, and leave every third out.
    """
    engine, device = placed
    if not isinstance(engine, Comparing):
        pytest.skip("the engine draws and compares one after the other")
    of, rng = case(name), torch.Generator().manual_seed(3)
    shape = 3, of.camera.height, of.camera.width
    target = torch.randint(256, shape, generator=rng, dtype=torch.uint8).to(device)
    background = of.background.to(device)
    leaves = of.moment.map(lambda t: t.detach().clone().to(device).requires_grad_())
    tensors = list(leaves.tensors().values())
    weights = None
    if chosen:
        tiles = math.prod(tile_grid(of.camera.width, of.camera.height))
        weights = torch.rand(tiles, generator=rng).to(device) * 3
        weights[::3] = 0
    frame = engine.rasterize(leaves, of.camera, background, of.sh_degree)
    judged = judge(frame, target, measure, weights)
    (on_screen,) = torch.autograd.grad(judged.unweighted, frame.means2d, retain_graph=True)
    results = []
    for found in (
        engine.compare(leaves, of.camera, background, target, measure, of.sh_degree, weights),
        Comparison(judged.loss, on_screen, judged.errors),
    ):
        gradients = torch.autograd.grad(2 * found.loss, tensors)
        errors = [] if found.errors is None else [found.errors]
        results.append([found.loss, *gradients, found.on_screen, *errors])
    return results[0], results[1]


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("name", CASES)
def test_comparing_is_drawing_and_then_comparing(
    placed: Placed, name: str, measure: Measure
) -> None:
    for found, expected in zip(*compared(placed, name, measure), strict=True):
        if placed[0] is load_engine("cuda"):  # which adds up in no fixed order
            assert_nearly_same(found, expected)
        else:
            torch.testing.assert_close(found, expected, atol=1e-7, rtol=1e-5)


def assert_nearly_same(found: Tensor, expected: Tensor) -> None:
    """Hold what is summed in another order to far less than a gradient may be off."""
    error, size = (found - expected).detach().norm(), expected.detach().norm()
    assert float(error) <= 0.1 * BACKWARD * float(size) + 1e-9


@pytest.mark.parametrize("measure", [Measure(0.0), Measure(0.0, 0.2)])
@pytest.mark.parametrize("name", CASES)
def test_tiles_count_by_their_weights(placed: Placed, name: str, measure: Measure) -> None:
    """Weights enter after the sum over a tile or before it; terms that cancel round otherwise."""
    for found, expected in zip(*compared(placed, name, measure, chosen=True), strict=True):
        assert_nearly_same(found, expected)


def test_tiles_cannot_be_weighted_where_ssim_counts(placed: Placed) -> None:
    with pytest.raises(ValueError, match="SSIM"):
        compared(placed, "64x48", Measure(0.2), chosen=True)


@pytest.fixture
def numba_threads() -> Iterator[None]:
    numba = pytest.importorskip("numba")
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.mark.usefixtures("numba_threads")
@pytest.mark.parametrize("name", ["64x48", "more than a batch in a tile", "17x33, axes"])
def test_result_does_not_depend_on_the_number_of_threads(name: str) -> None:
    import numba

    if "cpu" not in engine_names():
        pytest.skip("there is no engine cpu")
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba was started with one thread")
    engine, weights = load_engine("cpu"), pixel_weights(case(name))
    drawn: list[Drawing] = []
    losses: list[list[Tensor]] = []
    for threads in (1, 2):
        numba.set_num_threads(threads)
        drawn.append(draw(engine, case(name), weights, "cpu", torch.float32))
        losses.append([t for m in MEASURES for t in compared((engine, "cpu"), name, m)[0]])
        losses[-1] += compared((engine, "cpu"), name, Measure(0.0), chosen=True)[0]
    for found, expected in zip(*losses, strict=True):
        assert torch.equal(found, expected)
    one, two = drawn
    for image, pixels in vars(one.frame).items():
        other = getattr(two.frame, image)
        assert (pixels is None and other is None) or torch.equal(pixels, other), image
    for tensor, gradient in one.gradients.items():
        assert torch.equal(gradient, two.gradients[tensor]), tensor
