"""Centres of splats along a space-filling curve: in its order their codes grow slowly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.moving.parts import Floats, Integers, Part, Table, integers_of, quantised, short

AXES = 3
MOST_BITS = 16
"""Of a coordinate: three of them are an integer of 48 bits."""

LEAST_STEP = 1e-12

NAME = "means"


def warped(means: Floats, warp: float) -> Floats:
    """Return asinh(x / a) of coordinates: even steps of it are finer near the origin than far."""
    return np.arcsinh(means / warp)


def unwarped(values: Floats, warp: float) -> Floats:
    """Return the coordinates of ``warped`` values."""
    return warp * np.sinh(values)


def code_places(
    means: Floats, moving: int, step: float, warp: float
) -> tuple[Table, NDArray[np.intp]]:
    """Code centres, each of two blocks in the order of a Morton curve.

    Args:
        means: (N, 3), finite.
        moving: length of the first block.
        step: between two neighbouring places, in units of ``warp`` near the origin.
        warp: from about where on steps grow with the distance [world units].

    Returns:
        The increments of their codes, and which row of ``means`` each of them is.
    """
    values = warped(means, warp)
    least = short(values.min(axis=0) if len(values) else np.zeros(AXES))
    extent = float((values - least).max(initial=0.0))
    finest = extent / (2**MOST_BITS - 2)  # one less, since a short number may be less
    step = float(short(np.array([max(step, finest, LEAST_STEP)]))[0])
    codes = _interleaved(quantised(values, least, np.full(AXES, step)))
    blocks = np.split(np.arange(len(means)), [moving])
    order = [block[np.argsort(codes[block], kind="stable")] for block in blocks]
    increments = np.concatenate([np.diff(codes[rows], prepend=0) for rows in order])
    limits = tuple(least.tolist()), (step,) * AXES
    table = Table(NAME, increments[:, None], *limits, extra={"warp": warp})
    return table, np.concatenate(order)


def places_of(part: Part | Table, moving: int) -> Floats:
    """Return the centres (N, 3) of a part.

    Raises:
        ValueError: it is damaged.
    """
    increments = integers_of(part)[:, 0]
    codes = np.concatenate([np.cumsum(block) for block in np.split(increments, [moving])])
    q = _taken_apart(codes).astype(np.float64)
    values: Floats = np.asarray(part.least) + np.asarray(part.step) * q
    warp = part.extra.get("warp")
    return values if warp is None else unwarped(values, float(warp))


def _interleaved(q: Integers) -> Integers:
    """Return the Morton codes (N,) of coordinates (N, 3) of up to 16 bits."""
    codes = np.zeros(len(q), np.int64)
    for bit in range(MOST_BITS):
        for axis in range(AXES):
            codes |= (q[:, axis] >> bit & 1) << (AXES * bit + axis)
    return codes


def _taken_apart(codes: Integers) -> Integers:
    """Return the coordinates (N, 3) of Morton codes (N,)."""
    q = np.zeros((len(codes), AXES), np.int64)
    for bit in range(MOST_BITS):
        for axis in range(AXES):
            q[:, axis] |= (codes >> (AXES * bit + axis) & 1) << bit
    return q
