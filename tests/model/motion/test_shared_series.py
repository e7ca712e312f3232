"""Series over time that trajectories are sums of: the best there are, and what is made of them."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.model.motion import _shared_series
from gsdmsr_cli.model.motion._shared_series import fit_series, sum_series

TIMES, COUNT, COLUMNS = 9, 13, 2


def trajectories() -> Tensor:
    """Return values (T, N, C) at all times."""
    return torch.randn(TIMES, COUNT, COLUMNS, generator=generator()).double()


def fitted(values: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return what series make of values, and these and their shares."""
    means, series, shares = fit_series(values.__getitem__, len(values), count)
    sums = torch.stack([means + sum_series(row, shares) for row in series])
    return sums, series, shares


@pytest.mark.parametrize("count", [1, 3, TIMES - 1])
def test_no_series_fit_better(count: int) -> None:
    """What is left is what a singular value decomposition leaves (Eckart & Young 1936)."""
    values = trajectories()
    sums, series, _ = fitted(values, count)
    squares = torch.linalg.svdvals((values - values.mean(dim=0)).flatten(1)).square()
    torch.testing.assert_close((sums - values).square().sum(), squares[count:].sum())
    torch.testing.assert_close(series.T @ series / TIMES, torch.eye(count).double())


def test_more_series_than_trajectories_need_do_no_harm() -> None:
    values = trajectories()[:, :, :1] * torch.ones(COLUMNS).double()
    values[:, 1:] = values[:, :1]  # all splats go the same way: one series is enough
    for count in (1, 4, TIMES + 3):
        sums, series, shares = fitted(values, count)
        assert series.shape == (TIMES, count) and shares.shape == (COUNT, count, COLUMNS)
        torch.testing.assert_close(sums, values)


def test_series_are_found_from_some_of_many_splats(monkeypatch: pytest.MonkeyPatch) -> None:
    """And all have shares: of trajectories that two series say."""
    rng = generator(1)
    rows, shares = (torch.randn(*s, generator=rng).double() for s in ((TIMES, 2), (2, COUNT)))
    values = (rows @ shares)[:, :, None].expand(-1, -1, COLUMNS)
    monkeypatch.setattr(_shared_series, "SAMPLE", 4)
    torch.testing.assert_close(fitted(values, 2)[0], values)


def test_sums_are_products_and_differentiable() -> None:
    rng = generator(2)
    row, shares = torch.randn(5, generator=rng).double(), torch.randn(7, 5, 6, generator=rng)
    shares = shares.double().requires_grad_()
    torch.testing.assert_close(sum_series(row, shares), torch.einsum("k,nkc->nc", row, shares))
    assert torch.autograd.gradcheck(lambda given: sum_series(row, given), shares)


def test_sums_do_not_depend_on_where_a_splat_stands() -> None:
    shares, row = torch.randn(37, 7, 6, generator=generator(3)), torch.randn(7)
    rows = torch.randperm(37, generator=generator(4))
    assert torch.equal(sum_series(row, shares)[rows], sum_series(row, shares[rows]))
