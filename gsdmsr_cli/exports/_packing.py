"""Numbers of few bits, and splats in an order in which near ones follow one another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.gaussians.splats import Splats

Array = NDArray[Any]


def rounded(values: Array, largest: int) -> Array:
    """Return the whole numbers from 0 to ``largest`` that are nearest to the values, int64."""
    return np.clip(np.floor(values.astype(np.float64) + 0.5), 0, largest).astype(np.int64)


def smallest_three(quats: Array) -> tuple[Array, Array]:
    """Return the place of the largest component, (N,), and the others, (N, 3), in their order.

    quats is (N, 4), of unit length; their signs are chosen so that the largest is positive. The
    others lie between -1 / sqrt(2) and 1 / sqrt(2).
    """
    largest = np.abs(quats).argmax(axis=1)
    signs = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.arange(4)[None] != largest[:, None]
    return largest, (signs * quats)[others].reshape(-1, 3)


def morton_order(means: Array) -> Array:
    """Return the rows of (N, 3) points along a space-filling curve, (N,) int64."""
    low, high = means.min(axis=0, initial=np.inf), means.max(axis=0, initial=-np.inf)
    cells = rounded((means - low) / np.maximum(high - low, 1e-12) * 1023, 1023)
    codes = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes.argsort(kind="stable")


def beyond(splats: Splats, **limits: tuple[float, float]) -> list[str]:
    """Return which splats have values out of the limits of a format, a phrase for each tensor.

    Limits are by the name of the tensor; harmonics are "harmonics" without, "constants" for the
    first of each.
    """
    tensors = splats.tensors() | {"constants": splats.sh[:, :1], "harmonics": splats.sh[:, 1:]}
    phrases = []
    for name, (low, high) in limits.items():
        values = tensors[name].flatten(1)
        count = int(((values < low) | (values > high)).any(dim=1).sum())
        if count:
            phrases.append(f"{name} of {count} splats, outside {low:g} to {high:g}")
    return phrases
