"""Hash grids on tensors: looking features up, and gradients. See hash_grid.cu."""

from __future__ import annotations

import ctypes
from typing import Any

from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda.compiler import MOST_HASH_LEVELS
from gsdmsr_cli.backends.cuda.launch import blocks, launch
from gsdmsr_cli.ops.hash_grid.levels import MOST_AXES, PRIMES, Levels

_THREADS = 256


class _Packed(ctypes.Structure):
    """The levels as kernels take them."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("count", "axes", "width", "most")),
        ("factors", ctypes.c_uint * MOST_AXES),
        ("sizes", (ctypes.c_int * MOST_AXES) * MOST_HASH_LEVELS),
        ("offsets", ctypes.c_int * (MOST_HASH_LEVELS + 1)),
    )


def lookup(levels: Levels, table: Tensor, points: Tensor) -> Tensor:
    """Return the features (N, L F) of points (N, d), see ``ops.hash_grid.lookup``."""
    features: Tensor = _Lookup.apply(levels, table.contiguous(), points.contiguous())
    return features


def _pack(levels: Levels, width: int) -> _Packed:
    packed = _Packed(len(levels.resolutions), levels.axes, width, levels.most)
    packed.factors[:] = PRIMES
    packed.offsets[: len(levels.offsets)] = levels.offsets
    for sizes, level in zip(packed.sizes, levels.resolutions, strict=False):
        sizes[: levels.axes] = level
    return packed


class _Lookup(Function):
    @staticmethod
    def forward(ctx: Any, levels: Levels, table: Tensor, points: Tensor) -> Tensor:
        ctx.packed = _pack(levels, table.shape[1])
        features = points.new_empty(len(points), ctx.packed.count * table.shape[1])
        launch(
            "hash_grid", "lookup_hashed", (blocks(len(points), _THREADS), ctx.packed.count),
            _THREADS, ctx.packed, len(points), points, table, features,
        )  # fmt: skip
        ctx.save_for_backward(table, points)
        return features

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_features: Tensor) -> tuple[Tensor | None, ...]:
        table, points = ctx.saved_tensors
        given, packed = d_features.contiguous(), ctx.packed
        d_table, d_points = table.new_zeros(table.shape), None
        grid = blocks(len(points), _THREADS), packed.count
        launch(
            "hash_grid", "lookup_hashed_backward", grid, _THREADS,
            packed, len(points), points, given, d_table,
        )  # fmt: skip
        if ctx.needs_input_grad[2]:
            d_points = points.new_zeros(points.shape)
            launch(
                "hash_grid", "lookup_hashed_slopes", grid, _THREADS,
                packed, len(points), points, table, given, d_points,
            )  # fmt: skip
        return None, d_table, d_points
