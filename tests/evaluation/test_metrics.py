"""PSNR against its closed form; SSIM and MS-SSIM against other libraries and a plain loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity
from torch import Tensor
from torchmetrics.functional.image import multiscale_structural_similarity_index_measure

from gsdmsr_cli.evaluation.metrics import (
    MS_SSIM_SMALLEST,
    ms_ssim,
    psnr,
    psnr_fitted,
    quantize,
    ssim,
)
from gsdmsr_cli.ground import ssim as ssim_constants
from gsdmsr_cli.ops.photometric import cpu as photometric


def pair(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Return a random picture and a noisy copy."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(height, width, 3, generator=generator)
    return x, (x + 0.2 * torch.randn(x.shape, generator=generator)).clamp(0, 1)


def looped_ssim(x: np.ndarray, y: np.ndarray) -> float:
    """Return SSIM window by window in float64, zeros outside the picture."""
    offsets = np.arange(-5, 6)
    weights = np.exp(-(offsets[:, None] ** 2 + offsets[None, :] ** 2) / (2 * 1.5**2))
    weights /= weights.sum()
    padded = [np.pad(image, ((5, 5), (5, 5), (0, 0))) for image in (x, y)]
    values = []
    for row, column, channel in np.ndindex(*x.shape):
        a, b = (p[row : row + 11, column : column + 11, channel] for p in padded)
        ma, mb = (weights * a).sum(), (weights * b).sum()
        va, vb = (weights * (a - ma) ** 2).sum(), (weights * (b - mb) ** 2).sum()
        cov = (weights * (a - ma) * (b - mb)).sum()
        contrast = (2 * cov + 0.03**2) / (va + vb + 0.03**2)
        values.append((2 * ma * mb + 0.01**2) / (ma**2 + mb**2 + 0.01**2) * contrast)
    return float(np.mean(values))


@given(offset=st.floats(1e-3, 1.0))
def test_psnr_of_a_constant_offset_is_its_level(offset: float) -> None:
    target = torch.zeros(4, 5, 3, dtype=torch.float64)
    assert psnr(target + offset, target) == pytest.approx(-20 * math.log10(offset), abs=1e-9)


def test_psnr_averages_the_error_over_pixels_and_channels_before_the_logarithm() -> None:
    target = torch.zeros(2, 5, 3)
    rendered = target.clone()
    rendered[1, 3, 2] = 0.5  # one of 30 values
    assert psnr(rendered, target) == pytest.approx(10 * math.log10(30 / 0.25), abs=1e-5)


def test_psnr_of_identical_pictures_is_infinite_and_of_nan_is_nan() -> None:
    x, y = pair(6, 7)
    assert psnr(x, x) == math.inf
    y[0, 0, 0] = math.nan
    assert math.isnan(psnr(x, y))


def test_psnr_fitted_takes_exposure_and_white_balance_away() -> None:
    true = 0.2 + 0.6 * pair(16, 12)[0]
    mixing = torch.tensor([[0.7, 0.1, 0.0], [0.0, 0.8, 0.1], [0.1, 0.0, 0.6]])
    drawn = true @ mixing.T + 0.05
    assert psnr(drawn, true) < 25 and psnr_fitted(drawn, true) > 100


def test_psnr_fitted_is_of_the_least_squares() -> None:
    """What numpy's solver of least squares leaves, pixel by pixel."""
    drawn, true = (0.3 + 0.4 * picture for picture in pair(16, 12))
    rows = np.c_[drawn.reshape(-1, 3).double().numpy(), np.ones(16 * 12)]
    wanted = true.reshape(-1, 3).double().numpy()
    left = rows @ np.linalg.lstsq(rows, wanted, rcond=None)[0] - wanted
    expected = -10 * math.log10(float((left**2).mean()))
    assert psnr_fitted(drawn, true) == pytest.approx(expected, abs=1e-6)
    assert psnr_fitted(drawn, true) >= psnr(drawn, true)


def test_psnr_fitted_of_one_colour_and_of_nan() -> None:
    """One colour is fitted by the mean of the true picture."""
    true = pair(16, 12)[0]
    spread = float((true.double() - true.double().mean(dim=(0, 1))).square().mean())
    found = psnr_fitted(torch.full_like(true, 0.9), true)
    assert found == pytest.approx(-10 * math.log10(spread), abs=1e-6)
    assert math.isnan(psnr_fitted(torch.full_like(true, math.nan), true))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 14), (12, 11), (17, 20)])
def test_ssim_equals_the_loop_over_windows(height: int, width: int) -> None:
    x, y = pair(height, width)
    expected = looped_ssim(x.double().numpy(), y.double().numpy())
    assert ssim(x.double(), y.double()) == pytest.approx(expected, abs=1e-12)
    assert ssim(x, y) == pytest.approx(expected, abs=2e-6)


def test_ssim_equals_scikit_image_where_borders_do_not_differ() -> None:
    # Inside a black margin wider than the window, mirrored and zero padding are the same.
    pictures = []
    for image in pair(40, 31):
        padded = torch.zeros(60, 51, 3, dtype=torch.float64)
        padded[10:-10, 10:-10] = image
        pictures.append(padded)
    _, full = structural_similarity(
        *(p.numpy() for p in pictures),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    assert 0.3 < full.mean() < 0.95
    assert ssim(*pictures) == pytest.approx(full.mean(), abs=1e-9)


def test_ssim_is_one_for_identical_pictures_and_symmetric() -> None:
    x, y = pair(16, 13)
    assert ssim(x, x) == pytest.approx(1.0, abs=1e-6)
    assert ssim(x, y) == pytest.approx(ssim(y, x), abs=1e-7)
    assert ssim(x, y) < 0.95


def test_metrics_accept_pictures_that_carry_gradients() -> None:
    x, y = pair(8, 8)
    x.requires_grad_()
    assert math.isfinite(psnr(x, y))
    assert math.isfinite(ssim(x, y))


def smooth_pair(height: int, width: int, noise: float) -> tuple[Tensor, Tensor]:
    """Return a picture with structure at every scale, and a noisy copy."""
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    waves = [torch.sin(rows / p + channel) * torch.cos(columns / p)
             for channel in range(3) for p in (2.0, 9.0, 40.0)]  # fmt: skip
    x = 0.5 + torch.stack([sum(waves[3 * c : 3 * c + 3]) / 7 for c in range(3)], dim=-1)
    y = x + noise * torch.randn(x.shape, generator=torch.Generator().manual_seed(5))
    return x.clamp(0, 1), y.clamp(0, 1)


def torchmetrics_ms_ssim(x: Tensor, y: Tensor) -> float:
    batches = (image.permute(2, 0, 1)[None] for image in (x, y))
    return multiscale_structural_similarity_index_measure(*batches, data_range=1.0).item()


@pytest.mark.parametrize(("height", "width"), [(176, 176), (191, 240), (256, 177)])
@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_ms_ssim_equals_torchmetrics(height: int, width: int, noise: float) -> None:
    x, y = smooth_pair(height, width, noise)
    expected = torchmetrics_ms_ssim(x.double(), y.double())
    assert 0.2 < expected < 0.999
    # its exponents are rounded to float32, by 3e-8 of their size, and ln of a mean is below 10
    assert ms_ssim(x.double(), y.double()) == pytest.approx(expected, abs=3e-7)
    assert ms_ssim(x, y) == pytest.approx(expected, abs=1e-5)


def test_ms_ssim_of_identical_pictures_is_one_and_of_opposite_ones_zero() -> None:
    x, _ = smooth_pair(180, 180, 0.0)
    assert ms_ssim(x, x) == pytest.approx(1.0, abs=1e-6)
    assert ms_ssim(1 - x, x) == 0.0  # its contrast terms are negative


def test_ms_ssim_needs_room_for_five_scales_and_numbers() -> None:
    x, y = smooth_pair(MS_SSIM_SMALLEST, MS_SSIM_SMALLEST, 0.1)
    with pytest.raises(ValueError, match="176"):
        ms_ssim(x[1:], y[1:])
    y[80, 90, 1] = math.nan
    assert math.isnan(ms_ssim(x, y))


def chosen(height: int, width: int) -> Tensor:
    """Return a choice of some pixels."""
    return torch.rand(height, width, generator=torch.Generator().manual_seed(3)) < 0.3


def test_psnr_of_a_choice_is_that_of_its_pixels_alone() -> None:
    x, y = pair(13, 17)
    where = chosen(13, 17)
    alone = psnr(x[where][None], y[where][None])  # a picture of one row
    assert psnr(x, y, where) == pytest.approx(alone, abs=1e-9)
    spoilt = torch.where(where[..., None], x, torch.rand(13, 17, 3))
    assert psnr(spoilt, y, where) == psnr(x, y, where)


def test_psnr_of_a_part_and_of_the_rest_make_up_that_of_the_whole() -> None:
    x, y = pair(13, 17)
    where = chosen(13, 17)
    share = where.double().mean().item()
    errors = [10 ** (-psnr(x, y, part) / 10) for part in (where, ~where)]
    whole = share * errors[0] + (1 - share) * errors[1]
    assert psnr(x, y) == pytest.approx(-10 * math.log10(whole), abs=1e-9)


def test_ssim_of_a_choice_is_the_mean_of_its_windows() -> None:
    x, y = pair(14, 12)
    where = torch.zeros(14, 12, dtype=torch.bool)
    where[7, 5] = True
    window = (slice(2, 13), slice(0, 11))  # of the pixel (7, 5), all inside
    # zero padding of the 11 x 11 cut does not reach the window of its middle
    middle = torch.zeros(11, 11, dtype=torch.bool)
    middle[5, 5] = True
    assert ssim(x, y, where) == pytest.approx(ssim(x[window], y[window], middle), abs=1e-6)
    parts = chosen(14, 12)
    share = parts.double().mean().item()
    whole = share * ssim(x, y, parts) + (1 - share) * ssim(x, y, ~parts)
    assert ssim(x, y) == pytest.approx(whole, abs=1e-6)


def test_of_no_pixel_there_is_no_number() -> None:
    x, y = pair(12, 12)
    nowhere = torch.zeros(12, 12, dtype=torch.bool)
    assert math.isnan(psnr(x, y, nowhere)) and math.isnan(ssim(x, y, nowhere))


@pytest.mark.parametrize("metric", [psnr, ssim, ms_ssim])
def test_shapes_that_would_broadcast_are_refused(metric) -> None:
    with pytest.raises(ValueError, match=r"\(8, 9, 3\) and \(1, 9, 3\)"):
        metric(torch.zeros(8, 9, 3), torch.zeros(1, 9, 3))
    with pytest.raises(ValueError, match="H, W, 3"):
        metric(torch.zeros(3, 8, 9), torch.zeros(3, 8, 9))


def test_quantize_lands_on_eight_bit_levels() -> None:
    levels = torch.arange(256, dtype=torch.float32) / 255
    assert torch.equal(quantize(levels), levels)
    image = torch.tensor([-0.5, 0.4 / 255, 0.6 / 255, 1.7, math.nan])
    assert torch.equal(quantize(image)[:4], torch.tensor([0.0, 0.0, 1 / 255, 1.0]))
    assert quantize(image)[4].isnan()


@given(value=st.floats(0, 1))
def test_quantize_moves_by_at_most_half_a_level(value: float) -> None:
    image = torch.tensor(value, dtype=torch.float64)
    assert abs(quantize(image) - image).item() <= 0.5 / 255 + 1e-12


def test_the_window_is_the_gaussian_of_the_loss() -> None:
    weights = [math.exp(-(k**2) / (2 * 1.5**2)) for k in range(-5, 6)]
    np.testing.assert_allclose(ssim_constants.WINDOW, np.divide(weights, sum(weights)), rtol=1e-14)
    assert np.array_equal(ssim_constants.WINDOW.astype(np.float32), photometric.WINDOW)
