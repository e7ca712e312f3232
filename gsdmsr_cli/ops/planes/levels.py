"""The levels of a plane grid over space and time, and the box that it fills."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.backends.cpu.simd import LANES

Corner = tuple[float, float, float]
Box = tuple[Corner, Corner]
"""Lower and upper corner [world units], the upper one above the lower along every axis."""

CUBE: Box = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))

Place = Callable[[float], float]
"""Takes a time to where it lies on a grid, in [-1, 1]."""


def as_given(time: float) -> float:
    """Return a time that is one of the grid."""
    return time


def evenly(time: float) -> float:
    """Return where a time in [0, 1] lies on a grid that it is mapped to evenly, and whole."""
    return 2 * time - 1


DEGREES = 1, 3
"""Of the B-splines that may lie between nodes in time: straight lines, or cubic curves."""


def _bump(x: Tensor) -> Tensor:
    """Return the uniform cubic B-spline at x nodes from its middle; it is 0 from 2 on."""
    x = x.abs()
    inner, outer = 2 / 3 - x * x * (1 - x / 2), (2 - x).clamp(min=0) ** 3 / 6
    return torch.where(x < 1, inner, outer)


def cubic_weights(place: Tensor, count: int) -> Tensor:
    """Return what each of ``count`` nodes counts at a place () in [0, count - 1], (count,).

    The curve is the cubic B-spline whose coefficients the nodes are, continued by a node before the
    first and one after the last, each on a straight line with its two neighbours. So the curve ends
    at its first and last node, without curvature (a natural spline; de Boor, A Practical Guide to
    Splines, 2001, chapters IV and IX).

    Args:
        place: in cells from the first node on.
        count: 2 or more.
    """
    at = torch.arange(-1, count + 1, dtype=place.dtype, device=place.device)
    before, *_, after = own = _bump(at - place)
    weights: Tensor = own[1:-1].clone()
    weights[0] += 2 * before
    weights[1] -= before
    weights[-1] += 2 * after
    weights[-2] -= after
    return weights


class Level(NamedTuple):
    """One resolution of a grid of C channels, C a multiple of 16.

    Attributes:
        space: (3, C / 16, R, R, 16) the planes xy, xz, yz; the second axis of a plane comes first.
        time: (3, C / 16, T, R, 16) the planes of x, y, z against time.
    """

    space: Tensor
    time: Tensor

    @property
    def channels(self) -> int:
        """Number of features the level adds."""
        return int(self.space.shape[1]) * LANES


TIME_AXES = MappingProxyType({"time": 2})
"""Which dimension of a level's tensors runs over times, by their names."""


def new_level(resolution: int, times: int, channels: int, generator: torch.Generator) -> Level:
    """Return a level that starts as 4D-GS's do: space uniform in [0.1, 0.5], time 1.

    Args:
        resolution: nodes along each spatial axis, at least 2.
        times: nodes in time, at least 2.
        channels: a multiple of 16.
        generator: source of the random values.
    """
    if channels % LANES or channels < LANES or resolution < 2 or times < 2:
        raise ValueError(
            f"a level has a multiple of {LANES} channels and at least 2 nodes along each axis, "
            f"not {channels} channels, {resolution} nodes in space and {times} in time"
        )
    chunks = channels // LANES
    space = torch.rand(3, chunks, resolution, resolution, LANES, generator=generator)
    return Level(space * 0.4 + 0.1, torch.ones(3, chunks, times, resolution, LANES))


def new_levels(
    resolutions: Sequence[int], times: int, channels: int, generator: torch.Generator
) -> list[Level]:
    """Return a new level of each resolution; see ``new_level``."""
    return [new_level(resolution, times, channels, generator) for resolution in resolutions]


def features_of(levels: Sequence[Level]) -> int:
    """Return how many features the levels give together."""
    return sum(level.channels for level in levels)


def check_levels(levels: Sequence[Level]) -> None:
    """Raise ValueError unless every level has the shapes of ``Level``."""
    for space, time in levels:
        planes, chunks, size, _, lanes = space.shape
        fits = tuple(time.shape) == (3, chunks, time.shape[2], size, LANES) and time.shape[2] >= 2
        if (planes, lanes) != (3, LANES) or space.shape[3] != size or size < 2 or not fits:
            shapes = f"{tuple(space.shape)} in space and {tuple(time.shape)} in time"
            raise ValueError(f"a grid of shapes {shapes}, which do not fit together")


def to_cube(box: Box) -> NDArray[np.float64]:
    """Return what to multiply by and what to add, (2, 3), to take the box to [-1, 1]^3."""
    lower, upper = np.array(box)
    return np.stack([2 / (upper - lower), -(upper + lower) / (upper - lower)])
