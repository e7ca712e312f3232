"""Plane grids on tensors: looking features up, penalties, and their gradients.

See lookup.cuh and planes.cu.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda import recording
from gsdmsr_cli.backends.cuda.compiler import MOST_LEVELS, MOST_VIEWS
from gsdmsr_cli.backends.cuda.launch import blocks, launch
from gsdmsr_cli.ops.planes.levels import Place, as_given

CHANNELS = 16
"""Of a chunk, as in lookup.cuh."""

SOURCES = {
    torch.float32: "planes",
    torch.bfloat16: "planes_bf16",
    torch.float16: "planes_fp16",
}
"""Which source looks up nodes of a format."""

_THREADS = 256
_POINTERS = ("space", "time", "nodes", "lines", "d_space", "d_time", "d_lines")


class _Level(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_void_p) for name in _POINTERS),
        *((name, ctypes.c_int) for name in ("size", "times", "chunks")),
    )


class _Levels(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_int),
        ("moments", ctypes.c_int),
        ("cubic", ctypes.c_int),
        ("moment", ctypes.c_float * MOST_VIEWS),
        ("scale", ctypes.c_float * 3),
        ("shift", ctypes.c_float * 3),
        ("level", _Level * MOST_LEVELS),
    )


class _Times(NamedTuple):
    """Times at which a grid is read.

    Attributes:
        own: the times, in the order in which features are wanted.
        place: where each lies on the grid, in [-1, 1].
        degree: of the B-splines between nodes, see ``planes.lookup_at_times``.
    """

    own: Sequence[float]
    place: Place
    degree: int

    def placed(self) -> list[float]:
        """Return where they lie."""
        return [self.place(time) for time in self.own]

    def fill(self, packed: _Levels, inputs: Any) -> None:
        """Write the times of other inputs, see ``recording.vary``."""
        packed.moment[: len(self.own)] = self._replace(own=inputs.times).placed()


def lookup(
    points: Tensor,
    beside: Tensor,
    times: Sequence[float],
    to_cube: Sequence[Sequence[float]],
    tensors: Sequence[Tensor],
    dtype: torch.dtype = torch.float32,
    place: Place = as_given,
    degree: int = 1,
) -> Tensor:
    """Return features (V N, C + K) of points at V times, all levels and ``beside`` side by side.

    Args:
        points: (N, 3).
        beside: (N, K), the last columns.
        times: of which ``place`` says where they lie on the grid, in [-1, 1].
        to_cube: what to multiply positions by and what to add, (2, 3), to take them to [-1, 1].
        tensors: of each level space (3, chunks, R, R, 16) and time (3, chunks, T, R, 16).
        dtype: the format that grids are read in, see ``SOURCES``. Features are float32, and so
            are gradients, which pass through the rounding as if there were none.
        degree: see ``planes.lookup_at_times``.
    """
    given = points.contiguous(), beside, _Times(times, place, degree), to_cube, dtype
    features: Tensor = _Lookup.apply(*given, *tensors)
    return features


def penalty(weights: tuple[float, float, float], tensors: Sequence[Tensor]) -> Tensor:
    """Return what ``fields.planes.penalty`` does of grids, tensors as in ``lookup``."""
    value: Tensor = _Penalty.apply(weights, *tensors)
    return value


def _pack(
    moments: _Times,
    to_cube: Sequence[Sequence[float]],
    tensors: Sequence[Tensor],
    nodes: Sequence[Tensor],
    lines: Sequence[Tensor],
    gradients: Sequence[Tensor] = (),
    d_lines: Sequence[Tensor] = (),
) -> _Levels:
    """Return the levels as kernels take them; gradients are in the order of the tensors."""
    spaces, times = tensors[::2], tensors[1::2]
    if len(spaces) > MOST_LEVELS:
        raise ValueError(f"{len(spaces)} levels of grids; at most {MOST_LEVELS} are looked up")
    if len(moments.own) > MOST_VIEWS:
        raise ValueError(f"{len(moments.own)} times; at most {MOST_VIEWS} are looked up at once")
    cube = ((ctypes.c_float * 3)(*part) for part in to_cube)
    placed = (ctypes.c_float * MOST_VIEWS)(*moments.placed())
    packed = _Levels(len(spaces), len(moments.own), moments.degree > 1, placed, *cube)
    recording.vary(packed, moments.fill)
    columns = spaces, times, nodes, lines, gradients[::2], gradients[1::2], d_lines
    for name, column in zip(_POINTERS, columns, strict=True):
        for level, tensor in zip(packed.level, column, strict=False):
            if not tensor.is_contiguous():
                raise ValueError("kernels read contiguous tensors only")
            setattr(level, name, tensor.data_ptr())
    for level, plane in zip(packed.level, times, strict=False):
        level.chunks, level.times, level.size = plane.shape[1:4]
    return packed


def _over_levels(source: str, kernel: str, packed: _Levels, tensors: Sequence[Tensor]) -> None:
    """Launch a kernel with a thread for each value of a level's longest tensor."""
    longest = max(tensor.numel() for tensor in tensors)
    grid = blocks(longest, _THREADS), packed.count
    launch(source, kernel, grid, _THREADS, packed, on=tensors[0].device)


def _zeros_like(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return zeros of the shapes of the tensors, cleared at once."""
    flat = tensors[0].new_zeros(sum(tensor.numel() for tensor in tensors))
    parts = flat.split([tensor.numel() for tensor in tensors])
    return [part.view_as(tensor) for part, tensor in zip(parts, tensors, strict=True)]


class _Lookup(Function):
    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        beside: Tensor,
        times: _Times,
        to_cube: Sequence[Sequence[float]],
        dtype: torch.dtype,
        *tensors: Tensor,
    ) -> Tensor:
        spaces, halved, source = tensors[::2], dtype is not torch.float32, SOURCES[dtype]
        nodes = [torch.empty_like(t, dtype=dtype) for t in spaces] if halved else spaces
        count = len(times.own)
        lines = [space.new_empty(count, *space[:, :, 0].shape, dtype=dtype) for space in spaces]
        packed = _pack(times, to_cube, tensors, nodes, lines)
        ctx.columns = sum(space.shape[1] * CHANNELS for space in spaces)
        features = points.new_empty(count, len(points), ctx.columns + beside.shape[1])
        features[:, :, ctx.columns :] = beside
        _over_levels(source, "collapse", packed, [*nodes, *lines] if halved else lines)
        launch(
            source, "lookup", (blocks(len(points) * CHANNELS, _THREADS), 1), _THREADS,
            packed, len(points), points, features.shape[2], features,
        )  # fmt: skip
        ctx.given = times, to_cube, dtype, nodes if halved else None, lines
        ctx.save_for_backward(points, *tensors)
        return features.flatten(0, 1)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_features: Tensor) -> tuple[Tensor | None, ...]:
        points, *tensors = ctx.saved_tensors
        given, count = d_features.contiguous(), len(tensors) // 2
        times, to_cube, dtype, nodes, lines = ctx.given
        *d_spaces_and_lines, d_points = _zeros_like([*tensors[::2], *lines, points])
        d_spaces, d_lines = d_spaces_and_lines[:count], d_spaces_and_lines[count:]
        d_times = [torch.empty_like(time) for time in tensors[1::2]]
        gradients = [d for level in zip(d_spaces, d_times, strict=True) for d in level]
        read = tensors[::2] if nodes is None else nodes
        packed = _pack(times, to_cube, tensors, read, lines, gradients, d_lines)
        wanted, source = ctx.needs_input_grad[0], SOURCES[dtype]
        launch(
            source, "lookup_backward", (blocks(len(points) * CHANNELS, _THREADS), 1), _THREADS,
            packed, len(points), points, given.shape[1], given, d_points if wanted else None,
        )  # fmt: skip
        _over_levels(source, "spread", packed, d_times)
        d_beside = None
        if ctx.needs_input_grad[1]:
            own, count = given[:, ctx.columns :], len(times.own)
            d_beside = own if count == 1 else own.view(count, len(points), -1).sum(dim=0)
        return d_points if wanted else None, d_beside, None, None, None, *gradients


class _Penalty(Function):
    """The value and, in the same pass over memory, the gradients."""

    @staticmethod
    def forward(ctx: Any, weights: tuple[float, float, float], *tensors: Tensor) -> Tensor:
        space_weight, smooth_weight, still_weight = weights
        total = tensors[0].new_zeros((), dtype=torch.float64)
        ctx.gradients = [torch.empty_like(tensor) for tensor in tensors]
        for at in range(0, len(tensors), 2):
            (space, time), (d_space, d_time) = tensors[at : at + 2], ctx.gradients[at : at + 2]
            _, chunks, times, size, _ = time.shape
            nodes = chunks * CHANNELS * size
            launch(
                "planes", "space_penalty", (blocks(space.numel(), _THREADS), 1), _THREADS,
                3 * chunks, size, space_weight / (nodes * (size - 1)), space, d_space, total,
            )  # fmt: skip
            launch(
                "planes", "time_penalty", (blocks(time.numel(), _THREADS), 1), _THREADS,
                3 * chunks, times, size, smooth_weight / (nodes * max(times - 2, 1)),
                still_weight / (nodes * times), time, d_time, total,
            )  # fmt: skip
        return total.float()

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_value: Tensor) -> tuple[Tensor | None, ...]:
        return None, *torch._foreach_mul(ctx.gradients, d_value)
