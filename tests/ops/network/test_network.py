"""The small network: its start, the twin by gradcheck, the kernels against the twin."""

from __future__ import annotations

import math

import pytest
import torch
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from network_checks import layers_of, tensors_of
from torch import Tensor

from gsdmsr_cli.ops import network

WIDTHS = [[48, 64, 64, 10], [16, 3], [32, 16, 16], [16, 80, 33]]


def test_twin_passes_gradcheck() -> None:
    x = torch.randn(4, 6, generator=generator(1), dtype=torch.float64, requires_grad=True)
    tensors = leaves(tensors_of([6, 7, 5, 3]), torch.float64)

    def apply(x: Tensor, *tensors: Tensor) -> Tensor:
        return network.apply_network_twin(layers_of(list(tensors)), x)

    assert torch.autograd.gradcheck(apply, (x, *tensors))


@pytest.mark.parametrize("count", [0, 1, 3, 5, 333])
@pytest.mark.parametrize("widths", WIDTHS, ids=str)
def test_kernels_match_the_twin(widths: list[int], count: int) -> None:
    start = [torch.randn(count, widths[0], generator=generator(2)), *tensors_of(widths)]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = network.apply_network(layers_of(ours[1:]), ours[0])
    truth = network.apply_network_twin(layers_of(exact[1:]), exact[0])
    assert found.shape == (count, widths[-1])
    assert_near(found, truth, 1e-5, "output")
    weights = torch.randn(found.shape, generator=generator(3))
    (found * weights).sum().backward()
    (truth * weights).sum().backward()
    for i, (a, b) in enumerate(zip(ours, exact, strict=True)):
        assert_near(a.grad, b.grad, 1e-4, f"gradient {i}")


def test_rows_without_a_gradient_are_left_out() -> None:
    """Whatever they hold: here numbers that would spoil every sum."""
    for zero in (torch.arange(333) % 3 > 0, torch.arange(333) < 200, torch.ones(333) > 0):
        x = torch.randn(333, 48, generator=generator(8))
        spoilt = torch.where(zero[:, None], math.inf, x)
        results = []
        for rows, given in ((slice(None), spoilt), (~zero, x)):
            inputs, *tensors = leaves([given, *tensors_of([32, 16, 10])], torch.float32)
            y = network.apply_network(layers_of(tensors), inputs)[rows]
            y.backward(torch.where(zero[rows][:, None], 0.0, 1.0).expand_as(y))
            results.append([inputs.grad, *(tensor.grad for tensor in tensors)])
        for ours, truth in zip(*results, strict=True):
            assert_near(ours, truth, 1e-5, "gradients")


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_few_rows_that_are_not_finite_spoil_nothing_if_they_have_no_gradient(value: float) -> None:
    """Most rows have one, so that none is left out of the backward pass at first."""
    there = torch.arange(333) % 50 > 0
    x = torch.randn(333, 48, generator=generator(8))
    x[~there, 5] = value
    results = []
    for rows in (slice(None), there):
        inputs, *tensors = leaves([x[rows], *tensors_of([32, 16, 10])], torch.float32)
        y = network.apply_network(layers_of(tensors), inputs)
        y.backward(there[rows, None].float().expand_as(y))
        results.append((inputs.grad, [tensor.grad for tensor in tensors]))
    (d_x, shared), (d_finite, alone) = results
    assert torch.equal(d_x[there], d_finite) and not d_x[~there].any()
    for ours, truth in zip(shared, alone, strict=True):
        assert torch.equal(ours, truth)


def test_networks_side_by_side_are_the_networks_one_by_one() -> None:
    """The gradient of what they share is the sum, also where one reads fewer columns."""
    widths = [[16, 3], [48, 16, 10], [32, 32, 20]]
    start = [torch.randn(77, 48, generator=generator(7))]
    start += [tensor for seed, own in enumerate(widths) for tensor in tensors_of(own, seed)]
    results = []
    for together in (True, False):
        x, *tensors = leaves(start, torch.float32)
        layers = layers_of(tensors)
        networks = [layers[:1], layers[1:3], layers[3:]]
        if together:
            found = network.apply_networks(networks, x)
        else:
            found = tuple(network.apply_network(layers, x) for layers in networks)
        torch.cat(found, dim=1).square().sum().backward()
        results.append([*found, x.grad, *(tensor.grad for tensor in tensors)])
    for ours, truth in zip(*results, strict=True):
        assert_near(ours, truth, 1e-5, "outputs and gradients")


def test_inputs_need_not_be_contiguous_nor_want_a_gradient() -> None:
    x = torch.randn(32, 7, generator=generator(4)).T
    start = tensors_of([32, 16, 5])
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = network.apply_network(layers_of(ours), x)
    truth = network.apply_network_twin(layers_of(exact), x.double())
    assert_near(found, truth, 1e-5, "output")
    found.sum().backward()
    truth.sum().backward()
    for a, b in zip(ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-5, "gradient")


def test_a_new_network_is_zero_and_its_last_layer_can_learn() -> None:
    layers = network.new_network([48, 64, 10], generator())
    x = torch.randn(9, 48, generator=generator(5))
    weight = layers[-1].weight.requires_grad_()
    y = network.apply_network(layers, x)
    assert y.shape == (9, 10) and not y.any()
    y.sum().backward()
    assert weight.grad is not None and weight.grad.any()


def test_hidden_weights_have_the_variance_of_he() -> None:
    hidden = network.new_network([128, 256, 10], generator())[0]
    assert float(hidden.weight.var()) == pytest.approx(2 / 128, rel=0.05)
    assert float(hidden.weight.mean()) == pytest.approx(0, abs=0.002)
    assert not hidden.bias.any()


def test_widths_that_kernels_cannot_serve_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\[48, 20\] are not all multiples of 16"):
        network.new_network([48, 20, 10], generator())


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    start = [torch.randn(333, 48, generator=generator(6)), *tensors_of([48, 64, 64, 10])]

    def compute() -> list[Tensor]:
        ours = leaves(start, torch.float32)
        y = network.apply_network(layers_of(ours[1:]), ours[0])
        y.square().sum().backward()
        return [y, *(t.grad for t in ours if t.grad is not None)]

    assert len(compute()) == 1 + 7
    assert_same_on_threads(compute)
