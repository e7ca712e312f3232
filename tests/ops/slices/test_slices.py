"""Slices of Gaussians in space and time: the kernels against the twin.

That the twin conditions the paper's Gaussian on the time is held by the tests of ``covariance_4d``.
"""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from torch import Tensor

from gsdmsr_cli.ops.slices import slices, slices_twin

PARTS = "variances", "velocities", "axes"
GIVEN = "quats", "log scales", "tilts", "log durations"


def values(count: int, seed: int = 0) -> list[Tensor]:
    """Return quaternions and tilts of any length, and logarithms of scales and durations."""
    rng = generator(seed)
    shapes = (count, 4), (count, 3), (count, 4), (count,)
    return [torch.randn(shape, generator=rng) for shape in shapes]


def slopes(count: int) -> list[Tensor]:
    """Return gradients of slices, of which every third is 0."""
    rng = generator(5)
    found = [torch.randn(count, *shape, generator=rng) for shape in ((), (3,), (3, 3))]
    for tensor in found:
        tensor[1::3] = 0
    return found


def test_twin_passes_gradcheck() -> None:
    assert torch.autograd.gradcheck(
        lambda *given: tuple(slices_twin(*given)), leaves(values(3), torch.float64)
    )


@pytest.mark.parametrize("count", [0, 1, 15, 17, 333])
def test_kernels_match_the_twin(count: int) -> None:
    start = values(count)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found, truth = slices(*ours), slices_twin(*exact)
    for name, a, b in zip(PARTS, found, truth, strict=True):
        assert_near(a, b, 1e-6, name)
    given = slopes(count)
    torch.autograd.backward(list(found), given)
    torch.autograd.backward(list(truth), [slope.double() for slope in given])
    for name, a, b in zip(GIVEN, ours, exact, strict=True):
        assert_near(a.grad, b.grad, 2e-6, f"gradient of {name}")


def edges() -> list[Tensor]:
    """Return Gaussians that are upright, of quaternions of length 0, and too short in time."""
    start = values(4)
    start[2][0] = torch.tensor([2.0, 0.0, 0.0, 0.0])
    start[0][1] = start[2][2] = 0
    start[2][3], start[3][3] = torch.tensor([1.0, 0.0, 0.0, 0.0]), -30.0
    return start


def test_edges_are_those_of_the_twin() -> None:
    ours, exact = leaves(edges(), torch.float32), leaves(edges(), torch.float64)
    found, truth = slices(*ours), slices_twin(*exact)
    given = [torch.ones_like(part) for part in found]
    torch.autograd.backward(list(found), given)
    torch.autograd.backward(list(truth), [slope.double() for slope in given])
    for a, b in zip((*found, *(t.grad for t in ours)), (*truth, *(t.grad for t in exact)),
                    strict=True):  # fmt: skip
        assert a is not None and b is not None and a.isfinite().all()
        for row, other in zip(a, b, strict=True):
            assert_near(row, other, 1e-5, "row")


def test_what_is_not_finite_teaches_nothing_where_nothing_is_to_be_learnt() -> None:
    start, nowhere = values(40), [1, 4, 7, 10]
    for tensor, row in zip(start, nowhere, strict=True):
        tensor[row] = float("nan")
    ours = leaves(start, torch.float32)
    torch.autograd.backward(list(slices(*ours)), slopes(40))
    for tensor in ours:
        assert tensor.grad is not None and tensor.grad.isfinite().all() and tensor.grad.any()
        assert not tensor.grad[nowhere].any()


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    def compute() -> list[Tensor]:
        own = leaves(values(333), torch.float32)
        found = slices(*own)
        torch.autograd.backward(list(found), slopes(333))
        return [*found, *(t.grad for t in own if t.grad is not None)]

    assert len(compute()) == 7
    assert_same_on_threads(compute)
