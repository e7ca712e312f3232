"""Polynomial trajectories: the closed form, gradients, where they begin, and bad options."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from motion_checks import FACTS, disturbed, moved_by, splats_of, started
from scipy.special import eval_legendre
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layer import Instant, Layer, options_of
from gsdmsr_cli.model.parameter import tensors_of
from gsdmsr_cli.model.times import spread_times

COUNT, TIME = 6, 0.83


def in_float64(motion: Layer) -> Layer:
    for parameter in motion.parameters():
        parameter.set_values(parameter.tensor.double())
    return motion


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_it_is_its_formula(degree: int) -> None:
    """x + the bound times sums of P_k(2 t - 1) - P_k(2 mu - 1); q + (t - mu) w."""
    motion = in_float64(disturbed(started("polynomial", COUNT, degree=degree)))
    splats = splats_of(COUNT).map(Tensor.double)
    values = {name: t.detach().numpy() for name, t in motion.tensors().items()}
    moved = moved_by(motion, splats, TIME)
    for i, centre in enumerate(values["centres"]):
        gone = [eval_legendre(k, 2 * TIME - 1) - eval_legendre(k, 2 * centre - 1)
                for k in range(1, degree + 1)]  # fmt: skip
        way = FACTS.bound * np.array(gone) @ values["coefficients"][i]
        found = (moved.means - splats.means)[i].detach().numpy()
        np.testing.assert_allclose(found, way, rtol=1e-10, atol=1e-14)
        turned = splats.quats[i].numpy() + (TIME - centre) * values["turns"][i]
        np.testing.assert_allclose(moved.quats[i].detach().numpy(), turned, rtol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_it_is_a_polynomial_in_the_time_since_the_centre_without_a_constant(degree: int) -> None:
    """As the paper writes it: x + b_1 d + b_2 d^2 + b_3 d^3."""
    motion = in_float64(disturbed(started("polynomial", COUNT, degree=degree)))
    splats, times = splats_of(COUNT).map(Tensor.double), np.linspace(0, 1, 9)
    with torch.no_grad():
        ways = [(moved_by(motion, splats, t).means - splats.means).numpy() for t in times]
        centres = motion.tensors()["centres"].numpy()
    for i in range(COUNT):
        since, way = times - centres[i], np.stack(ways)[:, i]
        b, left, rank, _ = np.linalg.lstsq(since[:, None] ** np.arange(1, degree + 1), way)
        assert rank == degree and left.max() < 1e-24 and np.abs(b[-1]).max() > 1e-3


def test_its_gradients_are_right() -> None:
    motion = in_float64(disturbed(started("polynomial", COUNT)))
    splats = splats_of(COUNT).map(Tensor.double)
    trained = tensors_of(p for p in motion.parameters() if p.rate is not None)

    def moved(*values: Tensor) -> tuple[Tensor, Tensor]:
        for name, value in zip(trained, values, strict=True):
            setattr(motion, name, value)
        after = motion.at(Moment(splats), Instant(TIME)).splats
        return after.means, after.quats

    given = [tensor.detach().clone().requires_grad_() for tensor in trained.values()]
    assert list(trained) == ["coefficients", "turns"]
    assert torch.autograd.gradcheck(moved, given)


def test_ways_are_about_the_times_at_which_splats_were_seen() -> None:
    """Spread over time where that is not known; there a splat is where it is stored."""
    motion = disturbed(started("polynomial", COUNT))
    with torch.no_grad():
        motion.tensors()["centres"].copy_(spread_times(COUNT))
    known = torch.tensor([0.25, torch.nan, torch.nan, 1.0, torch.nan, 0.25])
    motion.begin_at(known)
    centres = torch.where(known.isnan(), spread_times(COUNT), known)
    assert torch.equal(motion.tensors()["centres"], centres)
    splats = splats_of(COUNT)
    moved = moved_by(motion, splats, 0.25)
    assert (moved.means == splats.means).all(dim=1).tolist() == (centres == 0.25).tolist()


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("degree", 0, "1 to 16"),
        ("degree", 17, "1 to 16"),
        ("rate", [1e-3, 0], r"\[start, end\], both above 0"),
        ("turn_rate", [-1e-3, 1e-4], r"\[start, end\], both above 0"),
    ],
)
def test_options_out_of_range_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"^motion: {option} is .*; allowed: {allowed}$"):
        options_of(motions.__name__, {"name": "polynomial", option: value})
