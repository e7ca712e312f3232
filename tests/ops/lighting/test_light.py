"""Colours of splats that have turned are their plain torch twins in float64."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, generator, leaves
from torch import Tensor

from gsdmsr_cli.ops.lighting import light, light_twin

NAMES = "sh", "slopes", "quats", "canonical quats"


def given(count: int, degree: int) -> list[Tensor]:
    shapes = (count, (degree + 1) ** 2, 3), (count, 3, 3), (count, 4), (count, 4)
    return [torch.randn(shape, generator=generator(seed)) for seed, shape in enumerate(shapes)]


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_colours_and_gradients(count: int, degree: int) -> None:
    start = given(count, degree)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found, truth = light(*ours), light_twin(*exact)
    assert_near(found, truth, 2e-6, "colours")
    slope = torch.randn(found.shape, generator=generator(9))
    found.backward(slope)
    truth.backward(slope.double())
    for name, one, other in zip(NAMES[:2], ours, exact, strict=False):
        assert_near(one.grad, other.grad, 2e-6, f"gradient of {name}")
    assert all(tensor.grad is None for tensor in (*ours[2:], *exact[2:]))


@pytest.mark.usefixtures("kernels_on_the_cpu")
def test_a_gpu_has_the_same(place: str) -> None:
    start = given(150, 3)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found, truth = light(*(tensor.to(place) for tensor in ours)).cpu(), light_twin(*exact)
    assert_near(found, truth, 2e-6, "colours")
    found.square().sum().backward()
    truth.square().sum().backward()
    assert_near(ours[1].grad, exact[1].grad, 4e-6, "gradient of slopes")


def test_what_is_not_finite_teaches_nothing_where_nothing_is_to_be_learnt() -> None:
    sh, slopes, quats, before = given(40, 1)
    quats[3] = float("nan")
    quats[5] = 0
    slopes.requires_grad_()
    weights = torch.ones(40, 4, 3)
    weights[3] = 0
    lit = light(sh, slopes, quats, before)
    assert torch.equal(lit[5], sh[5])
    lit.backward(weights)
    assert slopes.grad is not None and slopes.grad.isfinite().all() and slopes.grad.any()
