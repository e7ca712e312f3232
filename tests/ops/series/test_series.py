"""Series added to splats: the twin against single terms, the kernels against the twin."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from torch import Tensor

from gsdmsr_cli.ops.series import add_series, add_series_twin

NUMBERS = [0.3, -1.7, 0.9]
"""Values of a basis that all splats share."""

every_form = pytest.mark.parametrize("add", [add_series, add_series_twin])


def values(count: int, columns: int, stored: int, channels: int, terms: int) -> list[Tensor]:
    """Return a start, coefficients and the splats' own bases."""
    rng = generator(1)
    shapes = (count, columns), (count, stored, channels), (count, terms)
    return [torch.randn(shape, generator=rng) for shape in shapes]


@every_form
def test_terms_are_added_from_the_first_on_to_the_first_columns(add: Any) -> None:
    start, coefficients, basis = (t.double() for t in values(5, 6, 4, 3, 2))
    found = add(start, coefficients, basis, -1.3, 1)
    for i in range(5):
        expected = start[i].clone()
        for k in range(2):
            expected[:3] -= 1.3 * basis[i, k] * coefficients[i, 1 + k]
        torch.testing.assert_close(found[i], expected)


def test_twin_passes_gradcheck() -> None:
    own = leaves(values(3, 5, 4, 2, 3), torch.float64)
    assert torch.autograd.gradcheck(lambda *g: add_series_twin(*g, 0.7, 1), own)


@given(
    count=st.integers(1, 40) | st.just(333),
    channels=st.sampled_from([1, 3, 4, 12]),
    further=st.integers(0, 5),
    terms=st.integers(1, 9),
    first=st.integers(0, 3),
    behind=st.integers(0, 2),
)
@settings(max_examples=40, deadline=None)
def test_kernels_match_the_twin(
    count: int, channels: int, further: int, terms: int, first: int, behind: int
) -> None:
    sizes = channels + further, first + terms + behind, channels, terms
    start = values(count, *sizes)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found, truth = add_series(*ours, 1.3, first), add_series_twin(*exact, 1.3, first)
    assert_near(found, truth, 1e-6, "sums")
    slope = torch.randn(found.shape, generator=generator(2))
    slope[::3] = 0
    found.backward(slope)
    truth.backward(slope.double())
    for name, a, b in zip(("start", "coefficients", "basis"), ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-6, f"gradient of the {name}")


def test_a_basis_of_all_splats_is_one_of_each() -> None:
    start = values(37, 3, 3, 3, 3)[:2]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = add_series(*ours, NUMBERS, 2.0)
    truth = add_series_twin(*exact, torch.tensor(NUMBERS).double().expand(37, 3), 2.0)
    assert_near(found, truth, 1e-6, "sums")
    found.square().sum().backward()
    truth.square().sum().backward()
    for a, b in zip(ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-6, "gradient")


@every_form
@pytest.mark.parametrize("shared", [False, True])
def test_no_splats_get_nothing(add: Any, shared: bool) -> None:
    start, coefficients, basis = leaves(values(0, 3, 2, 3, 2), torch.float32)
    given = torch.ones(1, 2) if shared else basis
    add(start, coefficients, given).sum().backward()
    assert coefficients.grad is not None and coefficients.grad.shape == (0, 2, 3)


def test_what_is_not_finite_teaches_nothing_where_nothing_is_to_be_learnt() -> None:
    start = values(40, 3, 4, 3, 4)
    start[1][3], start[2][17] = float("nan"), float("inf")
    ours = leaves(start, torch.float32)
    slope = torch.ones(40, 3)
    slope[[3, 17]] = 0
    add_series(*ours).backward(slope)
    for tensor in ours:
        assert tensor.grad is not None and tensor.grad.isfinite().all()
        assert not tensor.grad[[3, 17]].any() and tensor.grad.any()


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    start = values(333, 12, 6, 3, 5)

    def compute() -> list[Tensor]:
        own = leaves(start, torch.float32)
        found = add_series(*own, 1.3, 1)
        found.square().sum().backward()
        return [found, *(t.grad for t in own if t.grad is not None)]

    assert len(compute()) == 4
    assert_same_on_threads(compute)
