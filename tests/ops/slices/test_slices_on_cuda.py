"""Slices of Gaussians in space and time by CUDA kernels are their twins in float64."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, generator, leaves

from gsdmsr_cli.ops.slices import cuda, slices_twin

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")


def given_of(place: str, count: int, upright: bool) -> None:
    """Compare slices and gradients; upright Gaussians are too short in time, some have no turn."""
    rng = generator(3)
    start = [torch.randn(count, *s, generator=rng) for s in ((4,), (3,), (4,), ())]
    if upright:
        start[2][:], start[3][:] = torch.tensor([1.0, 0.0, 0.0, 0.0]), -30.0
        start[0][::2] = 0
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = [part.cpu() for part in cuda.slices(*(tensor.to(place) for tensor in ours))]
    truth = slices_twin(*exact)
    for a, b in zip(found, truth, strict=True):
        assert_near(a, b, 1e-6, "slices")
    slopes = [torch.randn(part.shape, generator=rng) for part in found]
    for slope in slopes:
        slope[1::3] = 0  # rows that nothing is to be learnt from
    torch.autograd.backward(found, slopes)
    torch.autograd.backward(list(truth), [slope.double() for slope in slopes])
    for a, b in zip(ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-5, "gradients")


@pytest.mark.parametrize("count", [1, 127, 128, 150])
def test_slices_and_gradients(place: str, count: int) -> None:
    given_of(place, count, upright=False)


def test_upright_slices_and_gradients(place: str) -> None:
    given_of(place, 20, upright=True)


def test_what_is_not_finite_teaches_nothing_where_nothing_is_to_be_learnt(place: str) -> None:
    shapes = (4,), (3,), (4,), ()
    start = [torch.randn(40, *s, generator=generator(i)) for i, s in enumerate(shapes)]
    for row, tensor in enumerate(start):
        tensor[row] = float("nan")
    own = leaves(start, torch.float32)
    found = [part.cpu() for part in cuda.slices(*(tensor.to(place) for tensor in own))]
    slopes = [torch.ones_like(part) for part in found]
    for slope in slopes:
        slope[:4] = 0
    torch.autograd.backward(found, slopes)
    for tensor in own:
        assert tensor.grad is not None and tensor.grad.isfinite().all() and tensor.grad.any()
