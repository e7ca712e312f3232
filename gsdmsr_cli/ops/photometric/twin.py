"""The photometric loss in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.ground.measure import ALIKE, Measure
from gsdmsr_cli.ground.ssim import C1, C2, WINDOW


def photometric_loss_twin(rgb: Tensor, target: Tensor, measure: Measure) -> Tensor:
    """Return what ``photometric_loss`` does, in plain torch, for any device and dtype."""
    drawn, wanted = rgb.permute(2, 0, 1), target.to(rgb.dtype) / 255
    loss = (1 - measure.ssim) * distances(drawn - wanted, measure.quadratic).mean()
    if measure.ssim > 0:
        loss = loss + measure.ssim * (1 - ssim(drawn, wanted))
    return loss


def distances(differences: Tensor, quadratic: float) -> Tensor:
    """Return how far colours are apart of which these are the differences, see ``Measure``."""
    if quadratic == 0:
        return differences.abs()
    zero = torch.zeros((), dtype=differences.dtype, device=differences.device)
    huber = torch.nn.functional.huber_loss
    apart = huber(differences, zero.expand_as(differences), reduction="none", delta=quadratic)
    return apart / ALIKE


def ssim(x: Tensor, y: Tensor) -> Tensor:
    """Return the mean SSIM of pictures (3, H, W), zero padded (Wang et al. 2004)."""
    window = torch.as_tensor(WINDOW, dtype=x.dtype, device=x.device)
    kernel = torch.outer(window, window).expand(3, 1, -1, -1)

    def blur(z: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(z[None], kernel, padding=len(window) // 2, groups=3)[0]

    mx, my = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    luminance = (2 * mx * my + C1) / (mx * mx + my * my + C1)
    return (luminance * (2 * xy + C2) / (xx + yy + C2)).mean()
