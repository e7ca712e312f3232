"""Adam on CUDA kernels is its plain torch twin in float64, gated or not."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import generator

from gsdmsr_cli.backends.cuda.compiler import MOST_TENSORS
from gsdmsr_cli.ops.adam import Gate, Move, adam_steps_twin
from gsdmsr_cli.ops.adam.cuda import Row, adam
from gsdmsr_cli.ops.adam.moves import BETA1, BETA2, EPS

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")


def move(shape: tuple[int, ...], seed: int, gated: bool) -> Move:
    rng = generator(seed)
    values, gradient, first = (torch.randn(shape, generator=rng) for _ in range(3))
    second = torch.rand(shape, generator=rng)
    gate = None
    if gated:
        chosen = torch.tensor([0.0, 0.01, 1.0])[torch.randint(3, shape[:1], generator=rng)]
        gate = Gate(chosen, torch.full(shape, 7.0))
    return Move(values, gradient, first, second, 3 + seed, 0.1 / (1 + seed), gate)


def exact(of: Move) -> Move:
    doubles = [t.double() for t in of[:4]]
    gate = None if of.gate is None else Gate(of.gate.multipliers, of.gate.trace.double())
    return Move(*doubles, of.step, of.rate, gate)


def row(of: Move, place: str = "cpu") -> Row:
    step, inverse2 = of.rate / (1 - BETA1**of.step), 1 / (1 - BETA2**of.step)
    gate = () if of.gate is None else (part.to(place) for part in of.gate)
    return Row(*(tensor.to(place) for tensor in of[:4]), step, inverse2, *gate)


def assert_same_steps(place: str, moves: list[Move]) -> None:
    expected, rows = [exact(of) for of in moves], [row(of, place) for of in moves]
    adam_steps_twin(expected)
    adam(rows, BETA1, BETA2, EPS)
    for found, truth in zip(rows, expected, strict=True):
        pairs = [(found.values, truth.tensor), (found.first, truth.first)]
        pairs.append((found.second, truth.second))
        if truth.gate is not None and found.trace is not None:
            pairs.append((found.trace, truth.gate.trace))
        for one, other in pairs:
            torch.testing.assert_close(one.cpu().double(), other, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("shape", [(1,), (1000,), (257, 3), (65, 4, 3), (0, 3)])
def test_one_tensor(place: str, shape: tuple[int, ...], gated: bool) -> None:
    assert_same_steps(place, [move(shape, 0, gated)])


def test_more_tensors_than_one_launch_moves(place: str) -> None:
    assert_same_steps(place, [move((5 + i, 3), i, i % 2 == 0) for i in range(MOST_TENSORS + 3)])


def test_more_values_than_threads(place: str) -> None:
    """A thread of the largest grid then moves more than one value."""
    assert_same_steps(place, [move((300_000,), 1, False), move((3, 2), 2, True)])


def test_rows_without_a_factor_keep_their_bits() -> None:
    of = move((40, 3), 5, True)
    assert of.gate is not None
    kept = of.gate.multipliers == 0
    before = [t.clone() for t in (of.tensor, of.first, of.second)]
    adam([row(of)], BETA1, BETA2, EPS)
    for now, was in zip((of.tensor, of.first, of.second), before, strict=True):
        assert torch.equal(now[kept], was[kept])
        assert (now[~kept] != was[~kept]).any()


def test_strided_tensors_are_refused() -> None:
    strided = torch.zeros(2, 3).T
    with pytest.raises(ValueError, match="not contiguous"):
        adam([Row(strided, strided, strided, strided, 0.1, 1.0)], BETA1, BETA2, EPS)


@pytest.mark.parametrize("loss", [float("nan"), float("inf"), -float("inf")])
def test_a_loss_that_is_not_finite_moves_nothing(loss: float) -> None:
    of = move((40, 3), 5, True)
    assert of.gate is not None
    tensors = of.tensor, of.first, of.second, of.gate.trace
    before = [t.clone() for t in tensors]
    adam([row(of)], BETA1, BETA2, EPS, torch.tensor(loss))
    for now, was in zip(tensors, before, strict=True):
        assert torch.equal(now, was)
    adam([row(of)], BETA1, BETA2, EPS, torch.tensor(0.5))
    assert not torch.equal(of.tensor, before[0])
