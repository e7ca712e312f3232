"""Few numbers, or few rows of numbers, that stand for many: k-means, the same at every run."""

from __future__ import annotations

import numpy as np
import torch

from gsdmsr_cli.exports._packing import Array

CODES = 256

ROUNDS_OF_CODES, ROUNDS_OF_ROWS = 40, 8

BINS = 4096
"""Between the least value and the largest, in which they are counted."""

CHUNK = 2**24
"""Distances that are computed at once."""


def codebook(values: Array) -> tuple[Array, Array]:
    """Return ``CODES`` numbers in order, float32, and which one stands for each value, uint8.

    Values that are few are their own codes. Of many, each code becomes the mean of the values that
    are nearest to it, where there are any.
    """
    known = np.sort(values, axis=None).astype(np.float64)
    different = np.unique(known) if known.size else np.zeros(1)
    if len(different) <= CODES:
        codes = np.pad(different, (0, CODES - len(different)), mode="edge").astype("<f4")
        return codes, np.searchsorted(different, values).astype(np.uint8)
    codes = _spread(known)
    sums = np.concatenate([[0.0], np.cumsum(known)])
    for _ in range(ROUNDS_OF_CODES):
        ends = np.concatenate([[0], np.searchsorted(known, _borders(codes)), [known.size]])
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1)
        codes = np.where(counts > 0, means, codes)
    codes = np.sort(codes).astype("<f4")
    return codes, np.searchsorted(_borders(codes), values).astype(np.uint8)


def _spread(known: Array) -> Array:
    """Return codes for every value: half of them evenly, for those that are far from others.

    The others are as dense as the cube root of how dense values are, the best of very many codes.
    """
    counts, edges = np.histogram(known, BINS)
    dense = np.cbrt(counts)
    share = np.concatenate([[0.0], np.cumsum(dense + dense.mean())])
    return np.asarray(np.interp((np.arange(CODES) + 0.5) / CODES * share[-1], share, edges))


def _borders(codes: Array) -> Array:
    return np.asarray((codes[1:].astype(np.float64) + codes[:-1]) / 2)


def palette(rows: Array, count: int) -> tuple[Array, Array]:
    """Return at most ``count`` rows, and which one stands for each of the rows (N, C), int64.

    They begin with rows at even distances in the order given.
    """
    given = torch.from_numpy(rows.astype(np.float32))
    if len(rows) <= count:
        return rows, np.arange(len(rows))
    chosen = given[torch.linspace(0, len(rows) - 1, count).long()]
    for _ in range(ROUNDS_OF_ROWS):
        nearest = _nearest(given, chosen)
        counts = torch.bincount(nearest, minlength=count)[:, None]
        sums = torch.zeros_like(chosen).index_add_(0, nearest, given)
        chosen = torch.where(counts > 0, sums / counts.clamp(min=1), chosen)
    return chosen.numpy(), _nearest(given, chosen).numpy()


def _nearest(rows: torch.Tensor, to: torch.Tensor) -> torch.Tensor:
    """Return which of the rows ``to`` is nearest to each row, (N,) int64."""
    lengths = to.square().sum(dim=1)
    pieces = rows.split(max(1, CHUNK // len(to)))
    return torch.cat([(lengths - 2 * piece @ to.mT).argmin(dim=1) for piece in pieces])
