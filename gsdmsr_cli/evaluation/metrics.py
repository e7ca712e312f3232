"""Computes PSNR, SSIM and MS-SSIM as the tables of papers define them (METHODS.md 0.10)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from gsdmsr_cli.ground.ssim import C1, C2, REACH, WINDOW

PSNR_CAP = 100.0
"""JSON has no infinity: reports write this value [dB] for the PSNR of identical pictures."""

MS_SSIM_SMALLEST = 176
"""Least width and height [px] at which the fifth scale of MS-SSIM is as large as its window."""

_SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


@dataclass(frozen=True)
class Missing:
    """Why a metric has no value.

    Attributes:
        reason: one line; for files, which names were searched.
        searched: the folders that were searched, in order.
    """

    reason: str
    searched: tuple[str, ...]


def quantize(image: Tensor) -> Tensor:
    """Return ``image``, of any shape, clamped to [0, 1] and rounded to the nearest k / 255.

    This is what an 8-bit file would hold; NaN stays NaN, so that a broken render stays visible.
    """
    return (image.clamp(0.0, 1.0) * 255.0).round() / 255.0


def psnr(rendered: Tensor, target: Tensor, where: Tensor | None = None) -> float:
    """Return -10 log10(mean squared error over all pixels and channels) [dB].

    Identical pictures give inf; NaN in either gives NaN, as does a choice of no pixel.

    Args:
        rendered: (H, W, 3) floats in [0, 1].
        target: (H, W, 3) floats in [0, 1].
        where: (H, W) bools, the pixels that count; all of them if None.

    Raises:
        ValueError: the shapes differ or are not (H, W, 3).
    """
    _check_shapes(rendered, target)
    squares = (rendered.detach().double() - target.detach().double()).square()
    error = mean_of(squares.mean(dim=2), where)
    return -10.0 * math.log10(error) if error != 0.0 else math.inf


@torch.no_grad()
def psnr_fitted(rendered: Tensor, target: Tensor) -> float:
    """Return the PSNR [dB] after the affine transform of colours A c + b that is best for it.

    A is (3, 3), b is (3), both by least squares over all pixels; the result is clamped to [0, 1].
    So it does not count what a camera's exposure and white balance alone make of a picture, which
    is not known of one that nothing was trained on. See ``psnr`` for arguments, errors, and values
    without a number.
    """
    _check_shapes(rendered, target)
    colours = rendered.reshape(-1, 3).double()
    if not (colours.isfinite().all() and target.isfinite().all()):
        return math.nan
    rows = torch.cat([colours, torch.ones_like(colours[:, :1])], dim=1)
    products = rows.T @ target.reshape(-1, 3).double()
    fitted = rows @ (torch.linalg.pinv(rows.T @ rows, hermitian=True) @ products)
    return psnr(fitted.clamp(0.0, 1.0).reshape(rendered.shape), target)


@torch.inference_mode()
def ssim(rendered: Tensor, target: Tensor, where: Tensor | None = None) -> float:
    """Return the mean structural similarity over all pixels and channels, at most 1.

    The definition is that of 3DGS: Wang et al. 2004 with an 11 x 11 Gaussian window of sigma
    1.5 px, C1 = 0.01^2, C2 = 0.03^2 and 5 px of zero padding, so that borders count; packages
    that crop or mirror the border give other values. With a choice of pixels the mean is over
    them; the windows around them are as they are without it, so they reach beyond its edge.

    Args:
        rendered: (H, W, 3) floats in [0, 1].
        target: (H, W, 3) floats in [0, 1].
        where: (H, W) bools, the pixels that count; all of them if None.

    Raises:
        ValueError: the shapes differ or are not (H, W, 3).
    """
    return mean_of(similarity(rendered, target), where)


@torch.inference_mode()
def similarity(rendered: Tensor, target: Tensor) -> Tensor:
    """Return what ``ssim`` is the mean of, at every pixel, (H, W); see there."""
    _check_shapes(rendered, target)
    x, y = rendered.permute(2, 0, 1), target.to(rendered).permute(2, 0, 1)
    luminance, contrast = _similarity(x, y, padding=REACH)
    return (luminance * contrast).mean(dim=0)


@torch.inference_mode()
def ms_ssim(rendered: Tensor, target: Tensor) -> float:
    """Return the structural similarity over five scales, in [0, 1] (Wang et al. 2003).

    Each scale is the one before it, averaged over 2 x 2 pixels. The contrast terms of the first
    four and the whole similarity of the last are averaged over pixels and channels, raised to the
    power of their weight and multiplied; a negative mean counts as 0. The window is that of
    ``ssim``; in the first four scales it stays inside the picture, around the last, of which that
    would leave little, the picture is mirrored. This is what torchmetrics computes.

    Args:
        rendered: (H, W, 3) floats in [0, 1].
        target: (H, W, 3) floats in [0, 1].

    Raises:
        ValueError: the shapes differ or are not (H, W, 3), or a side is below ``MS_SSIM_SMALLEST``.
    """
    _check_shapes(rendered, target)
    if min(rendered.shape[:2]) < MS_SSIM_SMALLEST:
        raise ValueError(f"MS-SSIM needs {MS_SSIM_SMALLEST} px a side, not {rendered.shape[:2]}")
    x, y = rendered.permute(2, 0, 1), target.to(rendered).permute(2, 0, 1)
    means = []
    for _ in _SCALE_WEIGHTS[:-1]:
        _, contrast = _similarity(x, y, padding=0)
        means.append(float(contrast.mean(dtype=torch.float64)))
        x, y = F.avg_pool2d(x, 2), F.avg_pool2d(y, 2)
    x, y = (F.pad(image, 4 * [REACH], mode="reflect") for image in (x, y))
    luminance, contrast = _similarity(x, y, padding=0)
    means.append(float((luminance * contrast).mean(dtype=torch.float64)))
    if any(map(math.isnan, means)):
        return math.nan
    factors: list[float] = [
        max(mean, 0.0) ** weight for mean, weight in zip(means, _SCALE_WEIGHTS, strict=True)
    ]
    return math.prod(factors)


def _similarity(x: Tensor, y: Tensor, padding: int) -> tuple[Tensor, Tensor]:
    """Return the luminance and the contrast-structure terms of SSIM of two (C, H, W) pictures."""
    mean_x, mean_y, xx, yy, xy = _blur(torch.stack([x, y, x * x, y * y, x * y]), padding)
    var_x, var_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return luminance, (2 * covariance + C2) / (var_x + var_y + C2)


def _blur(maps: Tensor, padding: int) -> Tensor:
    """Convolve maps (M, C, H, W) with the Gaussian window, one axis at a time, zeros outside."""
    kernel = torch.from_numpy(WINDOW).to(maps)
    flat = maps.reshape(-1, 1, *maps.shape[-2:])
    flat = F.conv2d(flat, kernel.view(1, 1, 1, -1), padding=(0, padding))
    flat = F.conv2d(flat, kernel.view(1, 1, -1, 1), padding=(padding, 0))
    return flat.reshape(*maps.shape[:2], *flat.shape[-2:])


def mean_of(values: Tensor, where: Tensor | None) -> float:
    """Return the mean of (H, W) values over the chosen pixels, NaN if there are none."""
    chosen = values if where is None else values[where]
    return float(chosen.mean(dtype=torch.float64))


def _check_shapes(rendered: Tensor, target: Tensor) -> None:
    """Raise ValueError unless both are (H, W, 3) of one size."""
    if rendered.ndim != 3 or rendered.shape[2] != 3 or rendered.shape != target.shape:
        raise ValueError(
            f"pictures have shapes {tuple(rendered.shape)} and {tuple(target.shape)}, "
            "not both the same (H, W, 3)"
        )
