"""The photometric loss: distance of colours and structural dissimilarity to an 8-bit target."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cpu.simd import LANES
from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import TILE, tile_grid
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.photometric import cpu as kernels
from gsdmsr_cli.ops.photometric.twin import distances, photometric_loss_twin

__all__ = ["Measure", "photometric_loss", "photometric_loss_twin", "tile_errors"]


def photometric_loss(rgb: Tensor, target: Tensor, measure: Measure) -> Tensor:
    """Return the loss of a picture.

    Args:
        rgb: (H, W, 3) drawn picture.
        target: (3, H, W) uint8 picture.
        measure: what it is made of.
    """
    if choose(rgb) == "cpu":
        loss: Tensor = _Photometric.apply(rgb, target, measure)
        return loss
    return photometric_loss_twin(rgb, target, measure)


def tile_errors(rgb: Tensor, target: Tensor, quadratic: float) -> Tensor:
    """Return the sum of the distances in each tile, (tiles,) float64, row by row of tiles.

    Args:
        rgb: (H, W, 3) drawn picture.
        target: (3, H, W) uint8 picture.
        quadratic: see ``Measure``.
    """
    height, width, _ = rgb.shape
    rows, columns = tile_grid(width, height)
    differences = rgb - target.permute(1, 2, 0).to(rgb.dtype) / 255
    apart = distances(differences, quadratic).sum(dim=2).double()
    right, below = columns * TILE - width, rows * TILE - height
    whole = torch.nn.functional.pad(apart, (0, right, 0, below))
    return whole.view(rows, TILE, columns, TILE).sum(dim=(1, 3)).flatten()


class _Photometric(Function):
    """Value and gradient in one go: the gradient depends on what follows only by a factor."""

    @staticmethod
    def forward(ctx: Any, rgb: Tensor, target: Tensor, measure: Measure) -> Tensor:
        height, width, _ = rgb.shape
        planes = _planes(rgb)
        gradient = torch.empty_like(planes)
        loss = kernels.compare(
            array(planes), array(target), height, width, float(measure.ssim),
            measure.bend(), array(gradient),
        )  # fmt: skip
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
