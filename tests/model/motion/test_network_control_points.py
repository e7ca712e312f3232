"""SC-GS: splats are control points by themselves first, and follow a few of them later."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, moved_by, penalty_of, splats_of, started
from scipy.spatial.transform import Rotation
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.motion.network_control_points import NetworkControlPoints
from gsdmsr_cli.ops.skin import skin_twin, transforms_twin

COUNT = 40


def learnt(progress: float) -> NetworkControlPoints:
    """Return a motion that moves, in the stage of ``progress``."""
    motion = disturbed(started("network_control_points", COUNT, count=20))
    motion.advance(progress)
    return cast(NetworkControlPoints, motion)


@torch.no_grad()
def outputs(motion: NetworkControlPoints, points: Tensor, time: float) -> Tensor:
    return motion.network.apply(points / FACTS.bound, [time])[0]


@torch.no_grad()
def test_at_first_the_network_displaces_every_splat() -> None:
    splats, motion = splats_of(COUNT), learnt(0.09)
    moved = moved_by(motion, splats, 0.3)
    expected = splats.means + outputs(motion, splats.means, 0.3)[:, :3]
    torch.testing.assert_close(moved.means, expected)
    assert moved.quats is splats.quats and moved.log_scales is splats.log_scales


@torch.no_grad()
def test_later_splats_follow_the_control_points_near_them() -> None:
    splats, motion = splats_of(COUNT), learnt(0.1)
    moved = moved_by(motion, splats, 0.3)
    points = motion.control_points
    transforms = transforms_twin(points, outputs(motion, points, 0.3))
    near = torch.cdist(splats.means, points).argsort(dim=1)[:, :3].int()
    expected = skin_twin(splats, points, motion.log_radii, transforms, near)
    for name in ("means", "quats", "log_scales"):
        found, true = moved.tensors()[name], expected.tensors()[name]
        torch.testing.assert_close(found, true, atol=1e-5, rtol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize(("progress", "weight"), [(0.0, 2.0), (0.5, 0.2), (1.0, 0.02)])
def test_points_that_do_not_move_as_rigidly_as_possible_cost_what_rotations_leave(
    progress: float, weight: float
) -> None:
    """Of each point and its three nearest, itself among them, between two random times."""
    options = {"count": 20, "arap": [2.0, 0.02]}
    motion = disturbed(started("network_control_points", COUNT, **options))
    motion.advance(progress)
    found = penalty_of(motion, splats_of(COUNT), 0.3, generator(5))
    times = torch.rand(2, generator=generator(5)).tolist()
    points = cast(NetworkControlPoints, motion).control_points
    own = cast(NetworkControlPoints, motion)
    places = [(points + outputs(own, points, time)[:, :3]).numpy() for time in times]
    left, unit = 0.0, 0.0
    for i, near in enumerate(torch.cdist(points, points).argsort(dim=1)[:, 1:3].tolist()):
        ways = [place[near] - place[i] for place in places]
        left += Rotation.align_vectors(*ways)[1] ** 2
        unit += float((points[near] - points[i]).square().sum())
    assert found is not None and found.item() == pytest.approx(weight * left / unit, rel=1e-3)


def test_points_are_asked_of_the_network_without_a_gradient_for_their_places() -> None:
    splats, motion = splats_of(COUNT), learnt(0.0)
    splats.means.requires_grad_()
    moved_by(motion, splats, 0.3).means.sum().backward()
    assert splats.means.grad is not None and torch.equal(
        splats.means.grad, torch.ones_like(splats.means)
    )


def test_it_trains_in_both_stages_with_workers_without_and_resumed(
    tiny_scene: Path, tmp_path: Path
) -> None:
    own = "{name: network_control_points, count: 20, alone_until: 0.4, width: 16, depth: 3}"
    options = f"motion={own}", "optimizer.network=[0.01,0.001]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options)
    assert trainer.optimizer.steps["motion.log_radii"] < trainer.optimizer.steps["splats.means"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 3}, "count is 3; allowed: 4 or more"),
        ({"neighbours": 0}, "neighbours is 0; allowed: 1 to count, which is 512"),
        ({"gather": 0.0}, "gather is 0.0; allowed: 1 or more"),
        ({"alone_until": 1.5}, "alone_until is 1.5; allowed: a progress from 0 to 1"),
        ({"width": 24}, "width is 24; allowed: a multiple of 16"),
        ({"depth": 1}, "depth is 1; allowed: 2 to 16"),
        ({"time_octaves": 17}, "time_octaves is 17; allowed: 0 to 16"),
        ({"arap": [0, 1]}, r"arap is .*; allowed: \[start, end\], both above 0"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        started("network_control_points", COUNT, **options)
