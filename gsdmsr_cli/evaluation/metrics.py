"""PSNR and SSIM of one picture, as the papers' tables define them (METHODS.md 0.10)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

PSNR_CAP = 100.0
"""JSON has no infinity: reports write this value [dB] for the PSNR of identical pictures."""

_WINDOW = 11
_SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2


def quantize(image: Tensor) -> Tensor:
    """Return ``image``, of any shape, clamped to [0, 1] and rounded to the nearest k / 255.

    This is what an 8-bit file would hold; NaN stays NaN, so that a broken render stays visible.
    """
    return (image.clamp(0.0, 1.0) * 255.0).round() / 255.0


def psnr(rendered: Tensor, target: Tensor) -> float:
    """Return -10 log10(mean squared error over all pixels and channels) [dB].

    Identical pictures give inf; NaN in either gives NaN.

    Args:
        rendered: (H, W, 3) floats in [0, 1].
        target: (H, W, 3) floats in [0, 1].

    Raises:
        ValueError: the shapes differ or are not (H, W, 3).
    """
    _check_shapes(rendered, target)
    error = (rendered.detach().double() - target.detach().double()).square().mean().item()
    return -10.0 * math.log10(error) if error != 0.0 else math.inf


@torch.inference_mode()
def ssim(rendered: Tensor, target: Tensor) -> float:
    """Return the mean structural similarity over all pixels and channels, at most 1.

    The definition is that of 3DGS: Wang et al. 2004 with an 11 x 11 Gaussian window of sigma
    1.5 px, C1 = 0.01^2, C2 = 0.03^2 and 5 px of zero padding, so that borders count; packages
    that crop or mirror the border give other values.

    Args:
        rendered: (H, W, 3) floats in [0, 1].
        target: (H, W, 3) floats in [0, 1].

    Raises:
        ValueError: the shapes differ or are not (H, W, 3).
    """
    _check_shapes(rendered, target)
    x, y = rendered.permute(2, 0, 1), target.to(rendered).permute(2, 0, 1)
    mean_x, mean_y, xx, yy, xy = _blur(torch.stack([x, y, x * x, y * y, x * y]))
    var_x, var_y, covariance = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    structure = (2 * covariance + _C2) / (var_x + var_y + _C2)
    return float((luminance * structure).mean(dtype=torch.float64))


def _blur(maps: Tensor) -> Tensor:
    """Convolve maps (M, C, H, W) with the Gaussian window, one axis at a time, zeros outside."""
    offsets = torch.arange(_WINDOW, dtype=torch.float64) - _WINDOW // 2
    weights = torch.exp(-offsets.square() / (2 * _SIGMA**2))
    kernel = (weights / weights.sum()).to(maps)
    flat = maps.reshape(-1, 1, *maps.shape[-2:])
    flat = F.conv2d(flat, kernel.view(1, 1, 1, -1), padding=(0, _WINDOW // 2))
    flat = F.conv2d(flat, kernel.view(1, 1, -1, 1), padding=(_WINDOW // 2, 0))
    return flat.reshape(maps.shape)


def _check_shapes(rendered: Tensor, target: Tensor) -> None:
    """Raise ValueError unless both are (H, W, 3) of one size."""
    if rendered.ndim != 3 or rendered.shape[2] != 3 or rendered.shape != target.shape:
        raise ValueError(
            f"pictures have shapes {tuple(rendered.shape)} and {tuple(target.shape)}, "
            "not both the same (H, W, 3)"
        )
