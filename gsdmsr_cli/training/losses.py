"""The photometric loss: L1 and structural dissimilarity against an 8-bit target."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.kernels import photometric as kernels
from gsdmsr_cli.kernels.simd import LANES
from gsdmsr_cli.splatting_constants import TILE, tile_grid
from gsdmsr_cli.tensors import array, has_kernels


def photometric_loss(rgb: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Return (1 - w) mean |rgb - target| + w (1 - SSIM), as 3DGS does with w = 0.2.

    Args:
        rgb: (H, W, 3) drawn picture.
        target: (3, H, W) uint8 picture.
        ssim_weight: w in [0, 1].
    """
    if has_kernels(rgb):
        loss: Tensor = _Photometric.apply(rgb, target, ssim_weight)
        return loss
    return photometric_loss_twin(rgb, target, ssim_weight)


def photometric_loss_twin(rgb: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
    """Return what ``photometric_loss`` does, in plain torch, for any device and dtype."""
    drawn, wanted = rgb.permute(2, 0, 1), target.to(rgb.dtype) / 255
    loss = (1 - ssim_weight) * (drawn - wanted).abs().mean()
    if ssim_weight > 0:
        loss = loss + ssim_weight * (1 - _ssim(drawn, wanted))
    return loss


def tile_errors(rgb: Tensor, target: Tensor) -> Tensor:
    """Return the sum of |rgb - target| in each tile, (tiles,) float64, row by row of tiles.

    Args:
        rgb: (H, W, 3) drawn picture.
        target: (3, H, W) uint8 picture.
    """
    height, width, _ = rgb.shape
    rows, columns = tile_grid(width, height)
    differences = (rgb - target.permute(1, 2, 0).to(rgb.dtype) / 255).abs().sum(dim=2).double()
    right, below = columns * TILE - width, rows * TILE - height
    whole = torch.nn.functional.pad(differences, (0, right, 0, below))
    return whole.view(rows, TILE, columns, TILE).sum(dim=(1, 3)).flatten()


def _ssim(x: Tensor, y: Tensor) -> Tensor:
    """Return the mean SSIM of pictures (3, H, W), zero padded (Wang et al. 2004)."""
    window = torch.as_tensor(kernels.WINDOW, dtype=x.dtype, device=x.device)
    kernel = torch.outer(window, window).expand(3, 1, -1, -1)

    def blur(z: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(z[None], kernel, padding=len(window) // 2, groups=3)[0]

    mx, my = blur(x), blur(y)
    xx, yy, xy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mx * my + c1) / (mx * mx + my * my + c1)
    return (luminance * (2 * xy + c2) / (xx + yy + c2)).mean()


class _Photometric(Function):
    """Value and gradient in one go: the gradient depends on what follows only by a factor."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        height, width, _ = rgb.shape
        planes = _planes(rgb)
        gradient = torch.empty_like(planes)
        loss = kernels.compare(
            array(planes), array(target), height, width, float(ssim_weight), array(gradient)
        )
        ctx.gradient = gradient[:, :height, :width].permute(1, 2, 0)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_loss: Tensor) -> tuple[Tensor, None, None]:
        scale = float(d_loss)
        return ctx.gradient if scale == 1.0 else ctx.gradient * scale, None, None


def _planes(rgb: Tensor) -> Tensor:
    """Return the picture as contiguous planes whose width is a multiple of 16.

    The CPU engine's pictures are views of such planes and are not copied.
    """
    height, width, _ = rgb.shape
    planes = rgb.detach().permute(2, 0, 1)
    stride = planes.stride(1)
    rows = planes.stride(0) // max(stride, 1)
    whole = stride % LANES == 0 and stride >= width and planes.stride(2) == 1
    if whole and rows >= height and planes.stride(0) == rows * stride:
        return planes.as_strided((3, rows, stride), (rows * stride, stride, 1))
    result = torch.zeros(3, height, -(-width // LANES) * LANES)
    result[:, :, :width] = planes
    return result
