"""Displacing splats: the twin by definition, the kernel against the twin."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from motion_checks import splats_of
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ops.displace import OUTPUTS, displace, displace_twin


def arguments(count: int, shifted: bool) -> list[Tensor]:
    """Return a deformation and, if wanted, a shift."""
    rng = generator(count)
    widths = [OUTPUTS, 3] if shifted else [OUTPUTS]
    return [torch.randn(count, width, generator=rng) for width in widths]


def as_dtype(splats: Splats, dtype: torch.dtype) -> Splats:
    return splats.map(lambda t: t.to(dtype, copy=True).requires_grad_())


@pytest.mark.parametrize("move", [displace, displace_twin])
def test_every_column_has_its_place(move: object) -> None:
    assert callable(move)
    splats = splats_of(4)
    deformation, shift = torch.arange(10.0).expand(4, 10), torch.full((4, 3), 0.5)
    moved = move(splats, deformation, shift)
    torch.testing.assert_close(moved.means - splats.means, deformation[:, :3] + 0.5)
    torch.testing.assert_close(moved.quats - splats.quats, deformation[:, 3:7])
    torch.testing.assert_close(moved.log_scales - splats.log_scales, deformation[:, 7:])
    assert moved.sh is splats.sh and moved.logit_opacities is splats.logit_opacities


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("count", [0, 1, 333])
def test_the_kernel_matches_the_twin(count: int, shifted: bool) -> None:
    results = []
    for move, dtype in ((displace, torch.float32), (displace_twin, torch.float64)):
        splats = as_dtype(splats_of(count), dtype)
        given = leaves(arguments(count, shifted), dtype)
        moved = move(splats, *given)
        parts = [moved.means, moved.quats, moved.log_scales]
        rng = generator(5)
        loss = sum((part * torch.randn(part.shape, generator=rng)).sum() for part in parts)
        assert isinstance(loss, Tensor)
        loss.backward()
        inputs = [splats.means, splats.quats, splats.log_scales, *given]
        results.append([*parts, *(tensor.grad for tensor in inputs)])
    for i, (found, exact) in enumerate(zip(*results, strict=True)):
        assert_near(found, exact, 1e-6, str(i))


def test_the_deformation_may_be_a_part_of_a_wider_array() -> None:
    wide = torch.randn(7, 16, generator=generator(2))
    splats = splats_of(7)
    found = displace(splats, wide[:, :OUTPUTS])
    truth = displace_twin(splats, wide[:, :OUTPUTS])
    torch.testing.assert_close(found.means, truth.means)
    torch.testing.assert_close(found.log_scales, truth.log_scales)


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    given = arguments(333, True)
    splats = splats_of(333)

    def compute() -> list[Tensor]:
        moved = displace(splats, *given)
        return [moved.means, moved.quats, moved.log_scales]

    assert_same_on_threads(compute)
