"""What density control goes by, on gradients small enough to follow by hand."""

from __future__ import annotations

import math

import pytest
import torch
from kernel_checks import generator

from gsdmsr_cli.training.statistics import DensityStatistics


def test_statistics_are_means_over_the_views_that_drew_a_splat() -> None:
    statistics = DensityStatistics(3)
    statistics.observe(torch.tensor([[0.3, 0.0], [0.0, 0.0], [0.03, 0.08]]), 40, 20)
    statistics.observe(torch.tensor([[0.0, 0.1], [0.0, 0.0], [0.0, 0.0]]), 40, 20)
    # a pixel is 2 / 40 of the width and 2 / 20 of the height: times 20 and times 10
    expected = [(6.0 + 1.0) / 2, 0.0, 1.0]
    assert statistics.mean().tolist() == pytest.approx(expected)
    assert statistics.views.tolist() == [2, 0, 1]


def test_statistics_do_not_depend_on_the_resolution() -> None:
    gradient, statistics = torch.rand(5, 2, generator=generator()), []
    for scale in (1, 4):
        statistics.append(DensityStatistics(5))
        statistics[-1].observe(gradient / scale, 40 * scale, 20 * scale)
    torch.testing.assert_close(statistics[0].mean(), statistics[1].mean())


def test_views_of_one_size_are_observed_together_as_one_by_one() -> None:
    gradients = torch.randn(3, 7, 2, generator=generator())
    gradients[1, 2], gradients[0, 3], gradients[:, 4] = math.nan, 0, 0
    together, alone = DensityStatistics(7), DensityStatistics(7)
    together.observe_views(gradients, 40, 20)
    for gradient in gradients:
        alone.observe(gradient, 40, 20)
    torch.testing.assert_close(together.total, alone.total)
    assert torch.equal(together.views, alone.views)
    assert together.views.tolist() == [3, 3, 2, 2, 0, 3, 3]


def test_statistics_follow_rows_that_go_or_change_places() -> None:
    statistics = DensityStatistics(3)
    statistics.total, statistics.views = (
        torch.tensor([3.0, 6.0, 9.0]),
        torch.tensor([3.0, 3.0, 6.0]),
    )
    statistics.take(torch.tensor([2, 0]))
    assert statistics.total.tolist() == [9.0, 3.0] and statistics.views.tolist() == [6.0, 3.0]
    assert statistics.mean().tolist() == [1.5, 1.0]
