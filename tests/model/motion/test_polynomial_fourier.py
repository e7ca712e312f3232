"""The polynomial and the Fourier series that every splat has, against their closed form."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, moved_by, penalty_of, splats_of, started
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Layer
from gsdmsr_cli.model.motion.polynomial_fourier import time_basis

COUNT = 5
NAME = "polynomial_fourier"
ORDERS = {"degree": 2, "harmonics": 1, "colour_degree": 1, "colour_harmonics": 2, "period": 0.7}


def doubled(motion: Layer, splats: Splats) -> tuple[Layer, Splats]:
    """Return both with values of 64 bits."""
    for parameter in motion.parameters():
        parameter.set_values(parameter.tensor.double())
    return motion, splats.map(Tensor.double)


def series(coefficients: Tensor, s: float, degree: int, harmonics: int) -> Tensor:
    """Return the sum of one splat's series at its time s, term by term."""
    terms = [s**n for n in range(1, degree + 1)]
    angles = [2 * math.pi * k * s / ORDERS["period"] for k in range(1, harmonics + 1)]
    terms += [math.sin(a) for a in angles] + [math.cos(a) for a in angles]
    assert len(terms) == len(coefficients)
    return torch.stack([c * term for c, term in zip(coefficients, terms, strict=True)]).sum(dim=0)


@torch.no_grad()
@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_residuals_are_a_polynomial_and_a_series_at_the_splats_own_time(time: float) -> None:
    motion, splats = doubled(disturbed(started(NAME, COUNT, **ORDERS)), splats_of(COUNT))
    moved, own = moved_by(motion, splats, time), motion.tensors()
    for i in range(COUNT):
        s = float(own["log_time_scales"][i].exp() * (time - own["time_centres"][i]))
        for name in ("means", "quats"):
            residual = getattr(moved, name)[i] - getattr(splats, name)[i]
            unit = FACTS.bound if name == "means" else 1.0
            torch.testing.assert_close(residual, unit * series(own[name][i], s, 2, 1))
        colour = moved.sh[i, 0] - splats.sh[i, 0]
        torch.testing.assert_close(colour, series(own["colours"][i], s, 1, 2))
    assert torch.equal(moved.sh[:, 1:], splats.sh[:, 1:])
    assert torch.equal(moved.log_scales, splats.log_scales)
    assert torch.equal(moved.logit_opacities, splats.logit_opacities)


def test_gradients_are_those_of_finite_differences() -> None:
    motion, splats = doubled(disturbed(started(NAME, 3, **ORDERS)), splats_of(3))
    given = [t.requires_grad_() for t in (*motion.tensors().values(), splats.means, splats.quats)]

    def drawn(*_: Tensor) -> tuple[Tensor, ...]:
        moved = moved_by(motion, splats, 0.3)
        return moved.means, moved.quats, moved.sh

    assert torch.autograd.gradcheck(drawn, given)


def test_colours_without_terms_stay_as_they_are() -> None:
    motion = disturbed(started(NAME, COUNT, colour_degree=0, colour_harmonics=0))
    splats = splats_of(COUNT)
    assert "colours" not in motion.tensors()
    assert moved_by(motion, splats, 0.2).sh is splats.sh


def test_a_basis_without_harmonics_is_a_polynomial() -> None:
    times = torch.tensor([-0.5, 0.0, 2.0])
    found = time_basis(times, 3, 0, 1.0)
    assert torch.equal(found, torch.stack([times, times**2, times**3], dim=1))


def test_smoothness_is_the_mean_squared_way_within_a_frame() -> None:
    """Of splats that all move at 2 units a capture, in a scene of 20 train times."""
    motion, splats = started(NAME, COUNT, smoothness=3.0), splats_of(COUNT)
    with torch.no_grad():
        motion.tensors()["means"][:, 0] = torch.tensor([2.0 / FACTS.bound, 0.0, 0.0])
    found = penalty_of(motion, splats, 0.3, generator())
    assert found is not None
    assert found.item() == pytest.approx(3.0 * (2.0 / 19 / 1.3) ** 2, rel=1e-4)


def test_without_its_weight_there_is_no_penalty() -> None:
    motion = disturbed(started(NAME, 60, smoothness=0.0))
    assert penalty_of(motion, splats_of(60), 0.3, generator()) is None


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"degree": 0}, "degree is 0; allowed: 1 or more"),
        ({"harmonics": -1}, "harmonics is -1; allowed: 0 or more"),
        ({"colour_degree": -1}, "colour_degree is -1; allowed: 0 or more"),
        ({"period": 0.0}, "period is 0.0; allowed: a number above 0"),
        ({"time_rate": [1e-3, 0.0]}, "time_rate is .*; allowed: .start, end., both above 0"),
    ],
)
def test_orders_out_of_range_are_refused(options: dict[str, float], found: str) -> None:
    with pytest.raises(UsageError, match=found):
        started(NAME, 1, **options)


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(
        tiny_scene, tmp_path, f"motion={{name: {NAME}, harmonics: 1}}"
    )
    own = trainer.model.layers["motion"].tensors()
    assert {len(tensor) for tensor in own.values()} == {200}  # splats have grown
    assert all(tensor.any() for tensor in own.values())
