"""Curves that rows share: what they go through, and how many it takes."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from gsdmsr_cli.moving.curves import curves_at, track_of


def samples_of(kind: str, times: torch.Tensor) -> torch.Tensor:
    """Return (5, 3, T) of motions of five rows, each another of its kind."""
    rows = torch.linspace(0.5, 2, 15).reshape(5, 3, 1)
    if kind == "cubic":
        return rows * times**3 - rows**2 * times + rows**3
    if kind == "vibrating":  # with phases of their own
        return rows * torch.sin(7 * times + rows)
    return rows.expand(5, 3, len(times))


@pytest.mark.parametrize(("kind", "rank"), [("cubic", 3), ("vibrating", 2), ("still", 1)])
def test_a_motion_takes_as_many_curves_as_it_has_terms(kind: str, rank: int) -> None:
    times = torch.linspace(0, 1, 41, dtype=torch.float64)
    samples = samples_of(kind, times)
    track = track_of(samples)
    assert track.curves.shape == (41, rank)
    for place in (0, 17, 40):
        found = track.at(place / 40)
        assert torch.allclose(found, samples[:, :, place], atol=1e-9)


def test_between_two_times_it_is_the_cubic_of_the_format() -> None:
    values = torch.tensor([[0.0], [1.0], [-2.0], [3.0]], dtype=torch.float64)
    slopes = [1.0, -1.0, 1.0, 5.0]  # one-sided at the ends
    spline = CubicHermiteSpline(range(4), values[:, 0].numpy(), slopes)
    for time in (0.0, 0.1, 1 / 3, 0.5, 0.77, 1.0):
        assert math.isclose(float(curves_at(values, time)), spline(3 * time), abs_tol=1e-12)


@pytest.mark.parametrize("time", [-1.0, 2.0])
def test_times_outside_count_as_the_ends(time: float) -> None:
    values = torch.tensor([[1.0], [2.0], [5.0]])
    assert float(curves_at(values, time)) == (1.0 if time < 0 else 5.0)


def test_two_times_are_joined_by_a_line() -> None:
    values = torch.tensor([[1.0], [3.0]], dtype=torch.float64)
    assert math.isclose(float(curves_at(values, 0.25)), 1.5)
