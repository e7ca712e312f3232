"""Every motion finds the trajectories that it can say, from noise-free pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest
import torch
from recovery_checks import (
    COUNT,
    Case,
    Truth,
    assert_recovers,
    canonical_splats,
    lives_of,
    moved,
)
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.model import Model


def each_its_own_way(means: Tensor, time: float) -> Tensor:
    """Every splat goes on a straight line, each in another direction."""
    return means + (time - 0.5) * 0.5 * torch.nn.functional.normalize(means.roll(1, dims=1), dim=1)


def waving(means: Tensor, time: float) -> Tensor:
    """Splats swing about where they are, by how high they are and how far along."""
    x, y, z = means.unbind(1)
    offsets = [torch.sin(4 * time + 2 * z), torch.cos(3 * time + 2 * x), torch.sin(5 * time + y)]
    return means + 0.15 * torch.stack(offsets, dim=1)


def on_waves(means: Tensor, time: float) -> Tensor:
    """Every splat goes on a Fourier series of its own, of two octaves."""
    ways = 0.3 * torch.nn.functional.normalize(means.roll(1, dims=1), dim=1)
    slow, fast = math.pi * time, 2 * math.pi * time
    offset = math.sin(slow) * ways + 0.5 * math.cos(slow) * ways.roll(1, dims=1)
    return means + offset + 0.3 * math.sin(fast) * ways.roll(2, dims=1) - 0.2 * ways


def along_an_arc(means: Tensor, time: float) -> Tensor:
    """All splats go round one axis together, and up: a rigid motion."""
    turn, rise = 0.8 * (time - 0.5), 0.3 * (time - 0.5)
    x, y, z = means.unbind(1)
    cos, sin = math.cos(turn), math.sin(turn)
    return torch.stack([cos * x - sin * y, sin * x + cos * y, z + rise], dim=1)


def drifting_and_swinging(means: Tensor, time: float) -> Tensor:
    """Every splat drifts along a curve of its own, and swings beside it twice."""
    ways, since = torch.nn.functional.normalize(means.roll(1, dims=1), dim=1), time - 0.5
    drift = 0.4 * since + 0.3 * since**2
    return means + drift * ways + 0.08 * math.sin(4 * math.pi * since) * ways.roll(1, dims=1)


SPAN = 0.13
"""Standard deviation in time for which splats are seen."""


def seen_around(times: Tensor, period: float = math.inf) -> Truth:
    """Return the truth that splats are seen around times of their own, and swing or go straight on.

    Their velocities at these times are the same; a period without an end is a straight line.
    """
    turn = 2 * math.pi / period

    def truth(splats: Splats, time: float) -> Moment:
        since = time - times
        ways = torch.nn.functional.normalize(splats.means.roll(1, dims=1), dim=1)
        opacities = splats.logit_opacities.sigmoid() * torch.exp(-(since**2) / (2 * SPAN**2))
        way = torch.sin(turn * since) / turn if turn else since
        means = splats.means + 0.5 * way[:, None] * ways
        return Moment(replace(splats, means=means, logit_opacities=opacities.logit()))

    return truth


CENTRES = torch.linspace(0.2, 0.8, COUNT)

HALF_LIFE = SPAN * math.sqrt(2 * math.log(2))
"""Time after which half of the opacity is left."""

LIVES = torch.stack([CENTRES - HALF_LIFE, CENTRES + HALF_LIFE], dim=1).clamp(0, 1)


def along_a_cubic(means: Tensor, time: float) -> Tensor:
    """Every splat goes along a cubic of its own, out, back and out again."""
    ways = 0.25 * torch.nn.functional.normalize(means.roll(1, dims=1), dim=1)
    across = 0.25 * torch.nn.functional.normalize(means.roll(2, dims=1), dim=1)
    u = 2 * time - 1
    return means + (4 * u**3 - 3 * u) / 2 * ways + (u * u - 0.5) * across


SPANS = torch.stack([torch.linspace(0.15, 0.85, COUNT), torch.linspace(0.2, 0.35, COUNT)], dim=1)
"""When each splat is most opaque, and after which time 1 / e of that is left."""


def seen_for_a_while(splats: Splats, time: float) -> Moment:
    """Every splat goes along a cubic and is opaque around a time of its own."""
    centres, durations = SPANS.unbind(1)
    opacities = splats.logit_opacities.sigmoid() * torch.exp(-(((time - centres) / durations) ** 2))
    means = along_a_cubic(splats.means, time)
    return Moment(replace(splats, means=means, logit_opacities=opacities.logit()))


KEYS = torch.randn(COUNT, 7, 3, generator=torch.Generator().manual_seed(4)) / 10
"""Of each splat how far it is from its place at keyframes a quarter of the time apart, from one
before the first moment to one after the last."""


def through_keyframes(means: Tensor, time: float) -> Tensor:
    """Every splat goes through keyframes of its own, on cubics with tangents across neighbours."""
    before = min(int(4 * time), 3)
    u, y = 4 * time - before, KEYS[:, before : before + 4].unbind(1)
    first, last = (y[2] - y[0]) / 2, (y[3] - y[1]) / 2
    smooth = 3 * u**2 - 2 * u**3
    bends = (u**3 - 2 * u**2 + u) * first + (u**3 - u**2) * last
    return means + (1 - smooth) * y[1] + smooth * y[2] + bends


PRESENCE = torch.stack([torch.linspace(0.1, 0.4, COUNT), torch.linspace(0.6, 0.9, COUNT)], dim=1)
"""Between which times each splat is there; it appears and vanishes as a Gaussian of 0.15 does."""


def there_between_two_times(splats: Splats, time: float) -> Moment:
    """Every splat goes through keyframes, appears and vanishes."""
    outside = (PRESENCE[:, 0] - time).relu() + (time - PRESENCE[:, 1]).relu()
    opacities = splats.logit_opacities.sigmoid() * torch.exp(-((outside / 0.15) ** 2))
    means = through_keyframes(splats.means, time)
    return Moment(replace(splats, means=means, logit_opacities=opacities.logit()))


def lives_between(times: Tensor, duration: float) -> Tensor:
    """Return from when until when opacities with two Gaussian ends are above half of the most."""
    half = duration * math.log(2) ** 0.5
    return (times + half * torch.tensor([-1.0, 1.0])).clamp(0, 1)


def lives_around(centres: Tensor, durations: Tensor) -> Tensor:
    """Return from when until when Gaussian opacities are above half of the most, within [0, 1]."""
    half = durations * math.log(2) ** 0.5
    return torch.stack([centres - half, centres + half], dim=1).clamp(0, 1)


def along_two_arcs(means: Tensor, time: float) -> Tensor:
    """Every other splat goes round one way, the others the other way: two rigid bodies."""
    other = (torch.arange(len(means)) % 2 == 1)[:, None]
    return torch.where(other, along_an_arc(means, 1 - time), along_an_arc(means, time))


MORE_VIEWS = "training.views_per_step=4"
"""The gradient of L1 is as large for a splat that is nearly found as for one that is far off. Where
all share a network, what is nearly found drowns the one that is not; over more views it cancels."""

SMOOTH = MORE_VIEWS, "losses.ssim=0.3"
"""SSIM's gradient vanishes with the difference."""

CASES = {
    "control_points": Case(
        {
            "name": "control_points",
            "count": 16,
            "neighbours": 4,
            "levels": [4, 8],
            "time_ratio": 0.5,
        },
        moved(along_an_arc),
        options=SMOOTH,
        steps=1000,
    ),
    "polynomial": Case(
        {"name": "polynomial", "rate": [2e-2, 1e-4]},
        moved(along_a_cubic),
        steps=400,
        options=["optimizer.means=[5e-3,1e-5]"],
    ),
    "temporal_opacity": Case(
        {"name": "polynomial", "rate": [2e-2, 1e-4]},
        seen_for_a_while,
        steps=1200,
        layers=[{"name": "temporal_opacity", "centre_rate": [1e-2, 1e-4]}],
        options=["optimizer.means=[5e-3,1e-5]"],
        lives=lives_around(*SPANS.unbind(1)),
    ),
    "keyframes": Case(
        {"name": "keyframes", "keyframes": 5, "rate": [1e-2, 1e-4]}, moved(through_keyframes)
    ),
    "life_span": Case(
        {"name": "keyframes", "keyframes": 5, "rate": [1e-2, 1e-4]},
        there_between_two_times,
        layers=[{"name": "life_span", "centre_rate": [1e-2, 1e-4]}],
        steps=1200,
        lives=lives_between(PRESENCE, 0.15),
    ),
    "drift": Case(
        {"name": "static"},
        moved(each_its_own_way),
        layers=[{"name": "drift", "rate": [1e-2, 1e-4]}],
        steps=300,
    ),
    "network_control_points": Case(
        {
            "name": "network_control_points",
            "count": 16,
            "neighbours": 4,
            "alone_until": 0.4,
            "depth": 4,
            "position_octaves": 2,
            "time_octaves": 2,
        },
        moved(along_an_arc),
        options=("optimizer.network=[0.005,1e-5]",),
        steps=1000,
    ),
    "rigid_groups": Case(
        {"name": "rigid_groups", "count": 2, "rate": [0.015, 3e-5]},
        moved(along_two_arcs),
        steps=1000,
    ),
    "multiscale": Case(
        {"name": "multiscale", "coarse_until": 0.0, "time_ratio": 0.5}, moved(each_its_own_way)
    ),
    "hash_grids": Case(
        {
            "name": "hash_grids",
            "space_resolutions": [2, 8],
            "plane_resolutions": [2, 8],
            "time_resolutions": [4, 8],
            "width": 32,
            "smoothness": 0.01,
        },
        moved(each_its_own_way),
    ),
    "covariance_4d": Case(
        {
            "name": "covariance_4d",
            "duration": 0.3,
            "time_rate": [1e-2, 1e-4],
            "duration_rate": [2e-2, 1e-4],
            "tilt_rate": [1e-2, 1e-4],
        },
        seen_around(CENTRES),
        options=["optimizer.log_scales=[3e-3,1e-5]", "optimizer.quats=[3e-3,1e-5]"],
        steps=1000,
        lives=LIVES,
    ),
    "vibration": Case(
        {
            "name": "vibration",
            "period": 0.8,
            "smoothing": 0.0,
            "peak_rate": [1e-2, 1e-4],
            "life_span_rate": [2e-2, 1e-4],
        },
        seen_around(CENTRES, 0.8),
        lives=LIVES,
    ),
    "polynomial_fourier": Case(
        {"name": "polynomial_fourier", "rate": [1e-2, 1e-4]}, moved(drifting_and_swinging)
    ),
    "fourier": Case(
        {"name": "fourier"},
        moved(on_waves),
        options=("optimizer.means=[5e-3,1e-4]",),
        steps=1500,
    ),
    "deformation_network": Case(
        {
            "name": "deformation_network",
            "depth": 4,
            "position_octaves": 2,
            "time_octaves": 2,
            "noise": 0.01,
        },
        moved(waving),
        options=("optimizer.network=[0.01,1e-5]", MORE_VIEWS),
        steps=1500,
    ),
}
"""By the names of motions or layers; each has the trajectory that these are made for."""


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_known_trajectory_is_recovered(case: Case, tmp_path: Path) -> None:
    assert_recovers(case, tmp_path)


def test_a_motion_that_cannot_say_a_trajectory_does_not_pass(tmp_path: Path) -> None:
    """Or the test above would not say anything."""
    still = Case({"name": "static"}, moved(along_an_arc), steps=2)
    with pytest.raises(AssertionError):
        assert_recovers(still, tmp_path)


def test_lives_are_told_from_opacities() -> None:
    """Of splats that are there from 0.25 to 0.75, of a case with such a truth."""
    lives = torch.tensor([0.25, 0.75]).repeat(COUNT, 1)

    class Told:
        def instant(self, time: float) -> float:
            return time

        def at(self, time: float) -> Moment:
            splats = canonical_splats()
            seen = 3.0 if 0.25 <= time <= 0.75 else -9.0
            return Moment(replace(splats, logit_opacities=splats.logit_opacities * 0 + seen))

    found = lives_of(cast(Model, Told()))
    torch.testing.assert_close(found, lives, atol=1e-6, rtol=0)
