"""The photometric loss: the twin against other implementations, the kernels against the twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import assert_near, assert_same_on_threads, generator
from skimage.metrics import structural_similarity
from torch import Tensor

from gsdmsr_cli.evaluation.metrics import ssim
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import TILE
from gsdmsr_cli.ops.photometric import photometric_loss, photometric_loss_twin
from gsdmsr_cli.raster import cpu
from gsdmsr_cli.scene.camera import Camera

SIZES = [(1, 1), (5, 3), (16, 16), (17, 33), (37, 50), (64, 15)]
MEASURES = [
    Measure(0.0), Measure(0.2), Measure(1.0), Measure(0.0, 0.1), Measure(0.2, 0.3),
    Measure(0.0, 9.0),
]  # fmt: skip


def target_of(height: int, width: int) -> Tensor:
    return torch.randint(0, 256, (3, height, width), dtype=torch.uint8, generator=generator(1))


def picture_of(height: int, width: int, seed: int = 0) -> Tensor:
    return torch.rand(height, width, 3, generator=generator(seed)) * 1.4 - 0.2


def distance(difference: float, quadratic: float) -> float:
    """Return Huber's loss in units of a fortieth, or the size of a difference."""
    size = abs(difference)
    if not quadratic:
        return size
    return 40 * (size**2 / 2 if size <= quadratic else quadratic * (size - quadratic / 2))


def assert_matches_the_twin(
    rgb: Tensor, target: Tensor, measure: Measure, leaf: Tensor, rounding: float = 1e-6
) -> None:
    """Compare value and gradient, the latter in ``leaf``, of which ``rgb`` may be a view."""
    exact = rgb.detach().double().requires_grad_()
    found = photometric_loss(rgb, target, measure)
    truth = photometric_loss_twin(exact, target, measure)
    assert found.item() == pytest.approx(truth.item(), rel=1e-5, abs=rounding)
    (3 * found).backward()
    (3 * truth).backward()
    assert leaf.grad is not None
    gradient = leaf.grad if leaf is rgb else cpu.cropped(leaf.grad, *rgb.shape[:2])
    assert_near(gradient, exact.grad, 1e-3 if measure.ssim else 1e-6, "gradient")


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_a_plain_picture_matches_the_twin(height: int, width: int, measure: Measure) -> None:
    rgb = picture_of(height, width).requires_grad_()
    assert_matches_the_twin(rgb, target_of(height, width), measure, rgb)


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_a_crop_of_padded_planes_matches_the_twin(
    height: int, width: int, measure: Measure
) -> None:
    """What lies beyond the crop is what the engine drew there, and must not count."""
    rows, columns = (-(-size // TILE) * TILE for size in (height, width))
    planes = torch.rand(3, rows, columns, generator=generator(2)).requires_grad_()
    rgb = cpu.cropped(planes, height, width)
    assert_matches_the_twin(rgb, target_of(height, width), measure, planes)
    assert planes.grad is not None
    assert not planes.grad[:, height:].any() and not planes.grad[:, :, width:].any()


@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from(MEASURES))
@settings(max_examples=30, deadline=None)
def test_any_size_matches_the_twin(height: int, width: int, measure: Measure) -> None:
    rgb = picture_of(height, width, seed=height).requires_grad_()
    assert_matches_the_twin(rgb, target_of(height, width), measure, rgb)


def drawn_by_the_engine(height: int, width: int) -> tuple[Tensor, Splats]:
    rng = generator(3)
    splats = Splats(
        means=torch.rand(30, 3, generator=rng) * 2 - 1,
        quats=torch.randn(30, 4, generator=rng),
        log_scales=torch.rand(30, 3, generator=rng) - 2.5,
        logit_opacities=torch.randn(30, generator=rng),
        sh=torch.rand(30, 1, 3, generator=rng),
    ).map(torch.Tensor.requires_grad_)
    pose = np.eye(4)
    pose[2, 3] = 4.0
    camera = Camera(pose, width, width, width / 2, height / 2, width, height)
    return cpu.rasterize(Moment(splats), camera, torch.ones(3)).rgb, splats


def test_a_picture_of_the_cpu_engine_matches_the_twin_through_to_the_splats() -> None:
    target, gradients = target_of(37, 50), []
    for compare in (photometric_loss, photometric_loss_twin):
        rgb, splats = drawn_by_the_engine(37, 50)
        loss = compare(rgb, target, Measure(0.2))
        loss.backward()
        gradients.append([loss, *(tensor.grad for tensor in splats.tensors().values())])
    for i, (found, twin) in enumerate(zip(*gradients, strict=True)):
        assert found is not None and found.any()
        assert_near(found, twin, 1e-3, str(i))


def test_the_loss_leaves_its_picture_and_target_as_they_are() -> None:
    rgb, target = picture_of(20, 18), target_of(20, 18)
    before = rgb.clone(), target.clone()
    photometric_loss(rgb, target, Measure(0.2))
    assert torch.equal(rgb, before[0]) and torch.equal(target, before[1])


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_twin_is_the_distance_and_the_ssim_of_evaluation(
    height: int, width: int, measure: Measure
) -> None:
    rgb, target = picture_of(height, width).double().clamp(0, 1), target_of(height, width)
    wanted = target.permute(1, 2, 0).double() / 255
    apart = np.mean([distance(d, measure.quadratic) for d in (rgb - wanted).flatten().tolist()])
    expected = (1 - measure.ssim) * apart + measure.ssim * (1 - ssim(rgb, wanted))
    assert float(photometric_loss_twin(rgb, target, measure)) == pytest.approx(expected, rel=1e-6)


def test_twin_has_the_ssim_of_scikit_image_with_zeros_around() -> None:
    rgb, target = picture_of(19, 26).double().clamp(0, 1), target_of(19, 26)
    margin = ((16, 16), (16, 16), (0, 0))
    pair = [np.pad(x.numpy(), margin) for x in (rgb, target.permute(1, 2, 0).double() / 255)]
    _, values = structural_similarity(
        *pair, data_range=1.0, channel_axis=2, full=True,
        gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    )  # fmt: skip
    expected = 1 - values[16:-16, 16:-16].mean()
    assert float(photometric_loss_twin(rgb, target, Measure(1.0))) == pytest.approx(
        expected, rel=1e-6
    )


@pytest.mark.parametrize("measure", [Measure(0.2), Measure(1.0), Measure(0.2, 0.3)])
def test_twin_passes_gradcheck(measure: Measure) -> None:
    rgb, target = picture_of(6, 7).double().requires_grad_(), target_of(6, 7)
    assert torch.autograd.gradcheck(lambda x: photometric_loss_twin(x, target, measure), (rgb,))


@pytest.mark.parametrize("measure", MEASURES)
def test_a_perfect_picture_has_no_loss(measure: Measure) -> None:
    target = target_of(20, 30)
    rgb = target.permute(1, 2, 0).float() / 255
    assert photometric_loss(rgb, target, measure).item() == pytest.approx(0, abs=1e-6)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    target = target_of(70, 53)

    def compute() -> list[Tensor]:
        rgb = picture_of(70, 53).requires_grad_()
        loss = photometric_loss(rgb, target, Measure(0.2))
        loss.backward()
        assert rgb.grad is not None
        return [loss, rgb.grad]

    assert_same_on_threads(compute)


@given(st.integers(1, 130), st.integers(1, 130), st.booleans(), st.data())
@settings(max_examples=40, deadline=None)
def test_what_is_the_same_in_both_pictures_changes_nothing(
    height: int, width: int, white: bool, data: st.DataObject
) -> None:
    """Pictures that differ in a few places: elsewhere SSIM need not be computed.

    Variances of what is even are differences of large numbers, so rounding is that much larger.
    """
    target = torch.full((3, height, width), 255 if white else 0, dtype=torch.uint8)
    rgb = target.permute(1, 2, 0).float() / 255
    for _ in range(data.draw(st.integers(0, 3))):
        y, x = data.draw(st.integers(0, height - 1)), data.draw(st.integers(0, width - 1))
        size = data.draw(st.integers(1, 20))
        patch = (slice(y, y + size), slice(x, x + size))
        rgb[patch] = picture_of(height, width)[patch]
    rgb = rgb.clone().requires_grad_()
    assert_matches_the_twin(rgb, target, Measure(0.2), rgb, rounding=1e-5)
