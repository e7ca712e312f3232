"""Adam: against torch's own in float64, and what multipliers and resizes must leave alone."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import assert_same_on_threads, generator
from torch import Tensor

from gsdmsr_cli.ops.adam import Gate, Move, adam_steps, adam_steps_twin
from gsdmsr_cli.ops.adam.moves import BETA1, BETA2, EPS
from gsdmsr_cli.training.optimizer import Adam

SHAPES = [(1,), (16,), (7, 3), (33, 4, 3), (5, 4), (100,)]
STEPS = 6

Steps = Callable[[list[Move]], None]


def gate_of(values: Tensor, multipliers: Tensor | None) -> Gate | None:
    return None if multipliers is None else Gate(multipliers, torch.empty_like(values))


def gradients_of(shape: tuple[int, ...], seed: int = 0) -> list[Tensor]:
    """Return a gradient per step, over several orders of magnitude."""
    rng = generator(seed)
    size = torch.randn(shape, generator=rng).exp()
    return [torch.randn(shape, generator=rng) * size for _ in range(STEPS)]


def moved(
    steps: Steps,
    start: Tensor,
    gradients: list[Tensor],
    multipliers: Tensor | None = None,
    rate: float = 0.01,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return values and both moments after one step per gradient."""
    values = start.clone()
    first, second = torch.zeros_like(values), torch.zeros_like(values)
    for step, gradient in enumerate(gradients, start=1):
        gate = gate_of(values, multipliers)
        steps([Move(values, gradient.to(values.dtype), first, second, step, rate, gate)])
    return values, first, second


def by_torch(start: Tensor, gradients: list[Tensor], rates: list[float]) -> Tensor:
    values = start.double().requires_grad_()
    optimizer = torch.optim.Adam([values], betas=(BETA1, BETA2), eps=EPS)
    for gradient, rate in zip(gradients, rates, strict=True):
        optimizer.param_groups[0]["lr"] = rate
        values.grad = gradient.double()
        optimizer.step()
    return values.detach()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("ones", [False, True])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_steps_are_those_of_torch(shape: tuple[int, ...], ones: bool, dtype: torch.dtype) -> None:
    """float32 goes to the kernels, float64 to the twin; the rate changes from step to step."""
    start, gradients = torch.randn(shape, generator=generator(1)), gradients_of(shape)
    rates = [0.01 * 0.8**step for step in range(STEPS)]
    tensor, optimizer = start.to(dtype, copy=True).requires_grad_(), Adam()
    for gradient, rate in zip(gradients, rates, strict=True):
        tensor.grad = gradient.to(dtype)
        gate = gate_of(tensor, torch.ones(shape[0]) if ones else None)
        optimizer.step({"x": tensor}, {"x": rate}, {"x": gate} if gate else None)
        assert tensor.grad is None
    assert optimizer.steps == {"x": STEPS}
    expected = by_torch(start, gradients, rates)
    # 1 - beta2 in float32 is off by a relative 1.3e-5
    atol, rtol = (1e-6, 5e-5) if dtype == torch.float32 else (1e-12, 1e-12)
    travelled = tensor.detach().double() - start
    torch.testing.assert_close(travelled, expected - start, atol=atol, rtol=rtol)


@pytest.mark.parametrize("steps", [adam_steps, adam_steps_twin])
def test_the_multiplier_scales_the_step_of_its_row(steps: Steps) -> None:
    start, gradients = torch.zeros(35, 3), gradients_of((35, 3))[:1]
    factors = torch.tensor([1.0, 0.5, 2.0, 0.0, -1.0]).repeat(7)
    plain, first, second = moved(steps, start, gradients, torch.ones(35))
    scaled, first_scaled, second_scaled = moved(steps, start, gradients, factors)
    torch.testing.assert_close(scaled, plain * factors[:, None], atol=1e-9, rtol=1e-6)
    active = factors != 0
    assert torch.equal(first_scaled[active], first[active])
    assert torch.equal(second_scaled[active], second[active])


@pytest.mark.parametrize("steps", [adam_steps, adam_steps_twin])
@pytest.mark.parametrize("shape", [(6,), (6, 4, 3), (54, 3)], ids=str)
def test_a_row_with_multiplier_0_keeps_every_bit(steps: Steps, shape: tuple[int, ...]) -> None:
    """Even if its gradient is not a number."""
    rng = generator(2)
    values, first, second = (torch.rand(shape, generator=rng) for _ in range(3))
    before = [t.clone() for t in (values, first, second)]
    gradient = torch.randn(shape, generator=rng)
    factors = torch.tensor([1.0, 0.0, 0.5, 0.0, 1.0, 0.0]).repeat(shape[0] // 6)
    gradient[1], gradient[3] = float("nan"), float("inf")
    steps([Move(values, gradient, first, second, 3, 0.01, gate_of(values, factors))])
    skipped = factors == 0
    for now, old in zip((values, first, second), before, strict=True):
        assert torch.equal(now[skipped], old[skipped])
        assert (now[~skipped] != old[~skipped]).all()


@pytest.mark.parametrize("steps", [adam_steps, adam_steps_twin])
@given(exponent=st.integers(-6, 6))
@settings(max_examples=13, deadline=None)
def test_the_size_of_gradients_does_not_matter(steps: Steps, exponent: int) -> None:
    start, gradients = torch.zeros(9, 3), gradients_of((9, 3))
    scaled = [gradient * 2.0**exponent for gradient in gradients]
    plain = moved(steps, start, gradients)[0]
    torch.testing.assert_close(moved(steps, start, scaled)[0], plain, atol=1e-9, rtol=1e-5)


def test_the_first_step_has_the_length_of_the_rate() -> None:
    start, gradient = torch.zeros(20), gradients_of((20,))[0]
    values = moved(adam_steps, start, [gradient], rate=0.03)[0]
    torch.testing.assert_close(values, -0.03 * gradient.sign(), rtol=1e-5, atol=0)


@pytest.mark.parametrize("steps", [adam_steps, adam_steps_twin])
@pytest.mark.parametrize("multipliers", [None, torch.ones(20)], ids=["flat", "rows"])
@pytest.mark.parametrize("size", [1e-9, 1e-12, EPS])
def test_tiny_gradients_make_steps_of_nearly_the_rate(
    steps: Steps, multipliers: Tensor | None, size: float
) -> None:
    """The epsilon is added to the root: rate * g / (|g| + epsilon), half the rate where g is it."""
    gradient = torch.full((20,), size)
    gradient[::2] *= -1
    values = moved(steps, torch.zeros(20), [gradient], multipliers, rate=0.03)[0]
    expected = -0.03 * gradient.sign() * size / (size + EPS)
    torch.testing.assert_close(values, expected, rtol=1e-4, atol=0)


@pytest.mark.parametrize("steps", [adam_steps, adam_steps_twin])
def test_the_trace_is_the_step_with_multiplier_1(steps: Steps) -> None:
    rng = generator(5)
    start, first, second = torch.randn(21, 3, generator=rng), *torch.rand(2, 21, 3, generator=rng)
    gradient = torch.randn(21, 3, generator=rng)
    free, gated = start.clone(), start.clone()
    gate = gate_of(gated, torch.tensor([1.0, 0.0, 0.01]).repeat(7))
    assert gate is not None
    for values, its_gate in ((free, None), (gated, gate)):
        steps([Move(values, gradient, first.clone(), second.clone(), 3, 0.1, its_gate)])
    torch.testing.assert_close(gate.trace, start - free, atol=2e-7, rtol=1e-5)


@pytest.mark.parametrize("rows", [None, torch.full((40,), 0.5)], ids=["flat", "rows"])
def test_kernels_keep_pace_with_the_twin(rows: Tensor | None) -> None:
    start, gradients = torch.randn(40, 3, generator=generator(3)), gradients_of((40, 3))
    ours = moved(adam_steps, start, gradients, rows)
    exact = moved(adam_steps_twin, start.double(), gradients, rows)
    for found, truth in zip(ours, exact, strict=True):
        torch.testing.assert_close(found.double(), truth, atol=1e-6, rtol=5e-5)


def test_tensors_without_a_gradient_stay() -> None:
    still, moving = torch.ones(4, requires_grad=True), torch.ones(4, requires_grad=True)
    moving.grad = torch.ones(4)
    optimizer = Adam()
    optimizer.step({"still": still, "moving": moving}, {"still": 1.0, "moving": 0.1})
    assert torch.equal(still, torch.ones(4))
    assert (moving < 1).all()
    assert optimizer.steps == {"moving": 1}


def trained_adam() -> Adam:
    tensors = {name: torch.zeros(4, 3, requires_grad=True) for name in ("splats", "field")}
    optimizer = Adam()
    for tensor in tensors.values():
        tensor.grad = gradients_of((4, 3))[0]
    optimizer.step(tensors, dict.fromkeys(tensors, 0.1))
    return optimizer


def test_take_follows_the_parents_and_fresh_rows_have_no_moments() -> None:
    optimizer, before = trained_adam(), trained_adam()
    rows, fresh = torch.tensor([2, 0, 2, 3, 3]), torch.tensor([False, False, True, True, False])
    for name in ("splats", "never trained"):
        optimizer.take(name, rows, fresh)
    for now, old in ((optimizer.first, before.first), (optimizer.second, before.second)):
        assert torch.equal(now["splats"][~fresh], old["splats"][rows[~fresh]])
        assert not now["splats"][fresh].any()
        assert torch.equal(now["field"], old["field"])
        assert now.keys() == {"splats", "field"}
    assert optimizer.steps == before.steps


def test_momentum_is_reset_in_some_rows() -> None:
    optimizer, before = trained_adam(), trained_adam()
    rows = torch.tensor([True, False, False, True])
    for name in ("splats", "never trained"):
        optimizer.reset_momentum(name, rows)
    assert not optimizer.first["splats"][rows].any()
    assert torch.equal(optimizer.first["splats"][~rows], before.first["splats"][~rows])
    assert torch.equal(optimizer.second["splats"], before.second["splats"])
    assert torch.equal(optimizer.first["field"], before.first["field"])


def test_moments_of_one_tensor_are_reset() -> None:
    optimizer, before = trained_adam(), trained_adam()
    optimizer.reset_moments("splats", second=False)
    assert not optimizer.first["splats"].any()
    assert torch.equal(optimizer.second["splats"], before.second["splats"])
    optimizer.reset_moments("splats")
    optimizer.reset_moments("never trained")
    assert not optimizer.second["splats"].any()
    assert torch.equal(optimizer.first["field"], before.first["field"])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("second", [True, False])
def test_a_forgotten_moment_counts_its_steps_anew(second: bool, dtype: torch.dtype) -> None:
    """With both reset, the first step is the rate long, as any first step (closed form).

    With the first alone it is rate * g / sqrt(v), v the corrected second moment: constant
    gradients, whose mean square is their square, make that the rate again.
    """
    tensor, optimizer = torch.zeros(3, dtype=dtype, requires_grad=True), Adam()
    gradient = torch.tensor([2.0, -3.0, 1e-4], dtype=dtype)
    for _ in range(30):
        tensor.grad = gradient.clone()
        optimizer.step({"x": tensor}, {"x": 0.1})
    optimizer.reset_moments("x", second)
    rate, later = 0.1, gradient * (0.25 if second else 1.0)
    for _ in range(3):
        before, tensor.grad = tensor.detach().clone(), later.clone()
        optimizer.step({"x": tensor}, {"x": rate})
        expected = -rate * gradient.sign()
        torch.testing.assert_close(tensor.detach() - before, expected, rtol=1e-4, atol=0)


def test_a_first_moment_that_is_forgotten_twice_counts_from_the_last_time() -> None:
    optimizer = trained_adam()
    optimizer.reset_moments("splats", second=False)
    assert optimizer.steps["splats"] == optimizer.restarts["splats"] == 1
    optimizer.reset_moments("splats")
    assert optimizer.steps["splats"] == optimizer.restarts["splats"] == 0
    assert optimizer.steps["field"] == 1 and "field" not in optimizer.restarts


@pytest.mark.parametrize("rows", [False, True])
def test_results_do_not_depend_on_the_number_of_threads(rows: bool) -> None:
    start, gradients = torch.randn(333, 3, generator=generator(4)), gradients_of((333, 3))
    factors = torch.linspace(0, 1, 333) if rows else None
    assert_same_on_threads(lambda: moved(adam_steps, start, gradients, factors))
