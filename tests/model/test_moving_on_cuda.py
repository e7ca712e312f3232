"""Models move to several times at once as to one after the other, by a single lookup."""

from __future__ import annotations

from collections.abc import Sequence

import cuda_shim
import pytest
import torch
from kernel_checks import assert_near, generator
from motion_checks import disturbed, model_of, splats_of, started
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.model import Model

TIMES = (0.3, 1.0, 0.0)
LEARNT_FROM = torch.arange(40) % 3 > 0

TOLERANCES = {"float32": 1e-5, "bf16": torch.finfo(torch.bfloat16).eps}
"""Sums over the rows of all times are rounded once in place of once for each time."""


def gradients(model: Model, moments: Sequence[Moment]) -> list[Tensor | None]:
    rng, total = generator(5), torch.zeros(())
    for moment in moments:
        for tensor in moment.splats.tensors().values():
            total = total + (tensor * torch.randn(tensor.shape, generator=rng)).sum()
    return list(torch.autograd.grad(total, list(model.tensors().values()), allow_unused=True))


@pytest.mark.parametrize("precision", TOLERANCES)
@pytest.mark.parametrize("progress", [0.0, 1.0])
@pytest.mark.parametrize("mask", [None, LEARNT_FROM], ids=["all", "some"])
@pytest.mark.parametrize("moving", [0, 30, 40])
@pytest.mark.parametrize("name", ["multiscale", "hexplane", "control_points"])
def test_several_times_at_once(
    kernels_on_the_cpu: cuda_shim.Shim,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    moving: int,
    mask: Tensor | None,
    progress: float,
    precision: str,
) -> None:
    model = model_of(splats_of(40), disturbed(started(name, moving)), moving, precision)
    model.advance(progress)
    instants = [model.instant(time) for time in TIMES]
    alone = [model.at(instant, mask) for instant in instants]
    asked, launch = [], kernels_on_the_cpu.launch
    monkeypatch.setattr(
        kernels_on_the_cpu, "launch", lambda *given: (asked.append(given[1]), launch(*given))
    )
    together = model.at_instants(instants, mask)
    found, expected = gradients(model, together), gradients(model, alone)
    assert asked.count("lookup") == min(moving, 1)
    assert len(together) == len(TIMES)
    for moment, other in zip(together, alone, strict=True):
        for what, tensor in moment.splats.tensors().items():
            assert_near(tensor, other.splats.tensors()[what], 1e-6, what)
    tolerance = TOLERANCES[precision]
    for what, one, other in zip(model.tensors(), found, expected, strict=True):
        if other is not None and other.any():
            assert_near(one, other, tolerance, what)
