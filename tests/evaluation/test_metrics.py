"""PSNR against its closed form; SSIM against scikit-image and a loop over windows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import structural_similarity
from torch import Tensor

from gsdmsr_cli.evaluation.metrics import psnr, quantize, ssim


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


@pytest.mark.parametrize("metric", [psnr, ssim])
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
