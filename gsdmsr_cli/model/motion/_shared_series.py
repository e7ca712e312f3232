"""What splats do of their own, as sums of a few series over time that all of them share.

Trajectories are much alike, so that a few series and a share of each per splat say most of what
many times do: principal components, as of any set of curves.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

SAMPLE = 4096
"""Of how many splats, evenly spaced among all, the trajectories choose the series."""


def fit_series(
    at: Callable[[int], Tensor], times: int, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return means (N, C) over time, series (T, K) and shares (N, K, C).

    What ``at`` returns is, in least squares, the mean plus ``sum_series(series[time], shares)``.
    Series are orthogonal, and the mean of their squares is 1; those beyond T are 0.

    Args:
        at: returns C values of N splats at one of the times, (N, C); asked twice for each.
        times: T.
        count: K.
    """
    means = torch.zeros_like(at(0))
    step = max(1, -(-len(means) // SAMPLE))
    sample = torch.stack([at(time)[::step].flatten() for time in range(times)]).double()
    sample -= sample.mean(dim=0)
    found = torch.linalg.eigh(sample @ sample.T).eigenvectors.flip(1)[:, :count]
    series = means.new_zeros(times, count)
    series[:, : found.shape[1]] = times**0.5 * found
    shares = means.new_zeros(len(means), count, means.shape[1])
    for time in range(times):
        values = at(time) / times
        means += values
        shares += series[time, :, None] * values[:, None]
    return means, series, shares - series.mean(dim=0)[:, None] * means[:, None]


def sum_series(row: Tensor, shares: Tensor) -> Tensor:
    """Return the sums (N, C) of shares (N, K, C) of series whose values are ``row`` (K,).

    Added one after another: a product of matrices rounds a row by where it lies among others.
    """
    total = shares[:, 0] * row[0]
    for share, value in zip(shares.unbind(1)[1:], row[1:], strict=True):
        total = total + share * value
    return total
