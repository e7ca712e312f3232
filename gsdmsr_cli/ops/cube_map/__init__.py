"""Colours of all directions, on the faces of a cube, seen where a picture lets them through."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.cube_map import cpu as kernels
from gsdmsr_cli.ops.cube_map import cuda
from gsdmsr_cli.ops.cube_map.twin import directions, look, show_behind_twin
from gsdmsr_cli.scene.camera import Camera

__all__ = ["directions", "look", "show_behind", "show_behind_twin"]


def show_behind(
    rgb: Tensor, alpha: Tensor, colours: Tensor, points: Tensor, camera: Camera
) -> Tensor:
    """Return rgb + (1 - alpha) times the colour of each pixel's direction, (H, W, 3).

    Args:
        rgb, alpha: (H, W, 3), (H, W) of what has been drawn.
        colours: (M, 3) of the points on the surface of the cube.
        points: (6, n, n) int64, which of them is at each place of the faces; these are at the
            lower and upper end of x, of y and of z, with rows and columns along ``twin.BESIDE``.
        camera: whose pixels look through the cube's centre.
    """
    form = choose(rgb, alpha, colours)
    if form == "twin":
        return show_behind_twin(rgb, alpha, colours, points, camera)
    planes, lines = rgb.permute(2, 0, 1).contiguous(), lines_of(camera)
    given = planes, alpha.contiguous(), colours.contiguous(), points.contiguous(), lines
    found: Tensor = cuda.show(*given) if form == "cuda" else _Behind.apply(*given)
    return found.permute(1, 2, 0)


def lines_of(camera: Camera) -> NDArray[np.float32]:
    """Return the ways in the world from a pixel to the next of its row and of its column, and
    that of the first pixel's centre from the camera, the rows of (3, 3), not unit."""
    right, down = camera.rotation[0] / camera.fx, camera.rotation[1] / camera.fy
    first = camera.rotation[2] + (0.5 - camera.cx) * right + (0.5 - camera.cy) * down
    return np.stack([right, down, first]).astype(np.float32)


class _Behind(Function):
    @staticmethod
    def forward(
        ctx: Any, planes: Tensor, alpha: Tensor, colours: Tensor, points: Tensor, lines: Any
    ) -> Tensor:
        found = torch.empty_like(planes)
        kernels.show(*map(array, (planes, alpha, colours, points)), lines, array(found))
        ctx.save_for_backward(alpha, colours, points)
        ctx.lines = lines
        return found

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_found: Tensor) -> tuple[Tensor | None, ...]:
        alpha, colours, points = ctx.saved_tensors
        d_alpha, d_colours = torch.empty_like(alpha), torch.empty_like(colours)
        kernels.show_backward(
            *map(array, (alpha, colours, points)), ctx.lines, array(d_found.contiguous()),
            array(d_alpha), array(d_colours),
        )  # fmt: skip
        return d_found, d_alpha, d_colours, None, None
