"""Networks in half precision: held to twins in float64 that round the same values."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, generator, leaves
from motion_checks import disturbed, model_of, splats_at, splats_of, started
from network_checks import layers_of, tensors_of
from torch import Tensor

from gsdmsr_cli.ops import precision
from gsdmsr_cli.ops.network import Layer, half

HALVES = pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16], ids=str)

BACKWARD = torch.finfo(torch.bfloat16).eps
"""Twice the largest error of rounding a gradient, which is rounded once or twice per layer."""


def rounded(x: Tensor, dtype: torch.dtype) -> Tensor:
    """Rounded as float32 would be; gradients go through as if it were not."""
    return x + (x.float().to(dtype) - x).detach()


def twin(layers: list[Layer], x: Tensor, dtype: torch.dtype) -> Tensor:
    x = x[:, : len(layers[0].weight)]
    for i, (weight, bias) in enumerate(layers[:-1]):
        given = x if i else rounded(x, dtype)
        x = torch.addmm(rounded(bias, dtype), given, rounded(weight, dtype))
        x = rounded(torch.relu(x), dtype)
    return torch.addmm(layers[-1].bias, x, layers[-1].weight)


@HALVES
@pytest.mark.parametrize("count", [0, 1, 333])
@pytest.mark.parametrize("widths", [[48, 64, 64, 10], [32, 16, 16], [16, 3]], ids=str)
def test_values_and_gradients(widths: list[int], count: int, dtype: torch.dtype) -> None:
    start = [torch.randn(count, widths[0] + 16, generator=generator(2)), *tensors_of(widths)]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = half.apply_network(layers_of(ours[1:]), ours[0], dtype)
    truth = twin(layers_of(exact[1:]), exact[0], dtype)
    assert found.dtype is torch.float32
    # sums differ in the last bits of float32, and few of them are then rounded to the other side
    assert_near(found, truth, torch.finfo(dtype).eps / 8, "output")
    slope = torch.randn(found.shape, generator=generator(3))
    found.backward(slope)
    truth.backward(slope.double())
    for i, (one, other) in enumerate(zip(ours, exact, strict=True)):
        assert one.grad is not None and one.grad.dtype is torch.float32
        assert_near(one.grad, other.grad, BACKWARD, f"gradient {i}")


@HALVES
def test_tiny_gradients_are_as_exact_as_others(dtype: torch.dtype) -> None:
    """Of 1e-8, which is 0 in fp16, and of a millionth of that."""
    x, *tensors = leaves([torch.randn(99, 32), *tensors_of([32, 64, 64, 10])], torch.float32)
    result = half.apply_network(layers_of(tensors), x, dtype)
    slope = torch.randn(result.shape, generator=generator(3))
    for power in (27, 47):
        tiny = slope * 2.0**-power
        assert not tiny.half().any() or power == 27
        parts = [torch.autograd.grad(result, [x, *tensors], by, retain_graph=True)
                 for by in (slope, tiny)]  # fmt: skip
        for whole, small in zip(*parts, strict=True):
            assert whole.any() and torch.equal(whole, small * 2.0**power)


@HALVES
def test_large_gradients_do_not_overflow(dtype: torch.dtype) -> None:
    tensors = leaves(tensors_of([32, 64, 10]), torch.float32)
    result = half.apply_network(layers_of(tensors), torch.ones(999, 32), dtype)
    for gradient in torch.autograd.grad(result, tensors, torch.full_like(result, 1e6)):
        assert gradient.isfinite().all() and gradient.any()


@HALVES
def test_gradients_are_summed_in_float32_and_rounded_afterwards(dtype: torch.dtype) -> None:
    """Over 999 rows with a gradient of 10 a hidden unit: 9990, which bfloat16 does not have.

    Of a bias that is the gradient; of a weight it is rounded once, to a multiple of 64.
    """
    hidden, last = (torch.zeros(16, 16), torch.ones(16)), (torch.ones(16, 10), torch.zeros(10))
    tensors = leaves([*hidden, *last], torch.float32)
    result = half.apply_network(layers_of(tensors), torch.ones(999, 16), dtype)
    assert (result == 16).all()
    found = torch.autograd.grad(result, tensors, torch.ones_like(result))
    for gradient, expected in zip(found, (9984, 9990, 999, 999), strict=True):
        assert (gradient == expected).all()


def test_the_choice_of_a_format_ends_with_its_block() -> None:
    with pytest.raises(KeyError), precision.computing_in("half"):
        pass
    with pytest.raises(ZeroDivisionError), precision.computing_in("fp16"):
        assert precision.chosen() is torch.float16
        1 / 0  # noqa: B018
    assert precision.chosen() is torch.float32


@pytest.mark.parametrize("motion", ["multiscale", "hexplane"])
def test_a_model_of_half_precision_moves_in_float32_on_the_cpu(motion: str) -> None:
    splats, moving = splats_of(50), disturbed(started(motion, 50))
    whole, halved = (model_of(splats, moving, precision=name) for name in ("float32", "bf16"))
    assert torch.equal(splats_at(whole, 0.3).means, splats_at(halved, 0.3).means)


@pytest.mark.usefixtures("kernels_on_the_cpu")
@pytest.mark.parametrize("name", ["bf16", "fp16"])
@pytest.mark.parametrize("motion", ["multiscale", "hexplane"])
def test_a_model_of_half_precision_moves_in_it_where_kernels_of_a_gpu_run(
    motion: str, name: str
) -> None:
    splats, moving = splats_of(50), disturbed(started(motion, 50))
    models = [model_of(splats, moving, precision=precision) for precision in ("float32", name)]
    whole, halved = (splats_at(model, 0.3) for model in models)
    for found, expected, stored in zip(
        halved.tensors().values(), whole.tensors().values(), splats.tensors().values(), strict=True
    ):
        assert found.dtype is torch.float32
        moved, offset = found - stored, expected - stored
        assert (moved - offset).norm() <= 4 * torch.finfo(
            precision.FORMATS[name]
        ).eps * offset.norm()
    assert not torch.equal(halved.means, whole.means)
