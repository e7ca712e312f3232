"""Colours of directions on a GPU, see cube_map.cu."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda.launch import blocks, launch, struct

_THREADS = 128


def show(planes: Tensor, alpha: Tensor, colours: Tensor, points: Tensor, lines: Any) -> Tensor:
    """Return (3, H, W) drawn with what lies behind it, see ``ops.cube_map.show_behind``.

    ``lines`` is (3, 3) float32: the ways from a pixel to the next of its row and of its column, and
    to the first.
    """
    found: Tensor = _Behind.apply(planes, alpha, colours, points, lines)
    return found


class _Behind(Function):
    @staticmethod
    def forward(
        ctx: Any, planes: Tensor, alpha: Tensor, colours: Tensor, points: Tensor, lines: Any
    ) -> Tensor:
        found = torch.empty_like(planes)
        height, width = alpha.shape
        ctx.grid = blocks(width, _THREADS), height
        ctx.given = width, height, points.shape[1], struct(*map(float, lines.flatten()))
        launch(
            "cube_map", "show", ctx.grid, _THREADS,
            *ctx.given, planes, alpha, colours, points, found,
        )  # fmt: skip
        ctx.save_for_backward(alpha, colours, points)
        return found

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_found: Tensor) -> tuple[Tensor | None, ...]:
        alpha, colours, points = ctx.saved_tensors
        d_alpha, d_colours = torch.empty_like(alpha), torch.zeros_like(colours)
        launch(
            "cube_map", "show_backward", ctx.grid, _THREADS,
            *ctx.given, alpha, colours, points, d_found.contiguous(), d_alpha, d_colours,
        )  # fmt: skip
        return d_found, d_alpha, d_colours, None, None
