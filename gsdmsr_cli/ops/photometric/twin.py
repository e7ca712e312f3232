"""The photometric loss in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from gsdmsr_cli.ground.ssim import C1, C2, WINDOW


def photometric_loss_twin(rgb: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Return what ``photometric_loss`` does, in plain torch, for any device and dtype."""
    drawn, wanted = rgb.permute(2, 0, 1), target.to(rgb.dtype) / 255
    loss = (1 - ssim_weight) * (drawn - wanted).abs().mean()
    if ssim_weight > 0:
        loss = loss + ssim_weight * (1 - ssim(drawn, wanted))
    return loss


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
