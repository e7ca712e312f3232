"""Series added to splats by CUDA kernels are their plain torch twins in float64."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, generator, leaves

from gsdmsr_cli.ops.series import add_series_twin, cuda

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")


@pytest.mark.parametrize("own", [True, False], ids=["own bases", "one basis"])
@pytest.mark.parametrize(
    ("columns", "stored", "channels", "terms", "first"),
    [(3, 9, 3, 9, 0), (4, 1, 4, 1, 0), (12, 6, 3, 6, 0), (3, 12, 3, 4, 5)],
)
@pytest.mark.parametrize("count", [1, 128, 150])
def test_sums_and_gradients(
    place: str, count: int, columns: int, stored: int, channels: int, terms: int, first: int,
    own: bool,
) -> None:  # fmt: skip
    rng = generator(3)
    shapes = (count, columns), (count, stored, channels), (count if own else 1, terms)
    start = [torch.randn(shape, generator=rng) for shape in shapes]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    if not own:
        ours[2].requires_grad_(False)
    moved = [tensor.to(place) for tensor in ours]
    found = cuda.add_series(moved[0], moved[1], moved[2], 1.3, first).cpu()
    truth = add_series_twin(*exact, 1.3, first)
    assert_near(found, truth, 1e-6, "sums")
    slope = torch.randn(found.shape, generator=rng)
    slope[1::3] = 0  # rows that nothing is to be learnt from
    found.backward(slope)
    truth.backward(slope.double())
    for i, name in enumerate(("start", "coefficients", "basis")[: 2 + own]):
        assert_near(ours[i].grad, exact[i].grad, 1e-6, f"gradient of the {name}")


def test_what_is_not_finite_teaches_nothing_where_nothing_is_to_be_learnt(place: str) -> None:
    shapes = (40, 3), (40, 4, 3), (40, 4)
    start = [torch.randn(shape, generator=generator(3)) for shape in shapes]
    start[1][3], start[2][17] = float("nan"), float("inf")
    own, slope = leaves(start, torch.float32), torch.ones(40, 3)
    slope[[3, 17]] = 0
    cuda.add_series(*(tensor.to(place) for tensor in own), 1.0, 0).cpu().backward(slope)
    for tensor in own:
        assert tensor.grad is not None and tensor.grad.isfinite().all() and tensor.grad.any()
