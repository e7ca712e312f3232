"""Offsets of frames' times: what they do to a motion, their gradient, and that they are found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, moved_by, splats_of, start_motion, started
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.motion._time_offsets import Clock, TimeOffsets
from gsdmsr_cli.scene.camera import Camera

COUNT = 7


def along_a_parabola(times: Sequence[float], clock: Clock = float) -> Tensor:
    """Return 2 t^2 - t and 3 t at each time, (T, 1, 2): central differences of it are exact."""
    t = torch.tensor([clock(time) for time in times])
    return torch.stack([2 * t * t - t, 3 * t], dim=1)[:, None]


def followed(offsets: TimeOffsets, times: Sequence[float]) -> Tensor:
    return offsets.follow(lambda clock: along_a_parabola(times, clock), times)


def offsets_of(*values: float) -> TimeOffsets:
    offsets = TimeOffsets(len(values))
    offsets.parameters("time_offsets")
    with torch.no_grad():
        offsets.values.copy_(torch.tensor(values))
    return offsets


def test_a_frame_is_as_the_motion_is_when_it_was_taken() -> None:
    offsets = offsets_of(0.0, 0.5, -1.0, 0.0, 0.25)  # frames are 0.25 apart
    with torch.no_grad():
        found = followed(offsets, [0.25, 0.5, 0.375, 1.0])
    taken = [0.25 + 0.125, 0.5 - 0.25, 0.375 - 0.0625, 1.0 + 0.0625]
    torch.testing.assert_close(found, along_a_parabola(taken))


def test_the_gradient_of_an_offset_is_that_of_the_time() -> None:
    offsets, weights = offsets_of(0.0, 0.5, -1.0, 0.0, 0.25), torch.tensor([[[0.7, -0.2]]])
    (followed(offsets, [0.25, 0.625]) * weights).sum().backward()
    t, u = 0.375, 0.625 - 0.5 * 0.25
    slopes = [0.25 * (0.7 * (4 * s - 1) - 0.2 * 3) for s in (t, u)]
    expected = torch.tensor([0.0, slopes[0], slopes[1] / 2, slopes[1] / 2, 0.0])
    torch.testing.assert_close(offsets.values.grad, expected)


def test_times_a_frame_outside_of_the_first_and_the_last_are_inside() -> None:
    offsets = TimeOffsets(11)
    places = [offsets.inside(time) for time in (-0.2, -0.1, 0.0, 0.5, 1.0, 1.1, 1.2)]
    assert places == pytest.approx([0, 0, 1 / 12, 0.5, 11 / 12, 1, 1])


def test_frames_that_were_taken_at_other_times_are_found() -> None:
    """A known motion; every frame says that it was taken at another time than it was."""
    true = torch.empty(9).uniform_(-0.4, 0.4, generator=generator())
    offsets, times = offsets_of(*[0.0] * 9), [i / 8 for i in range(9)]
    shown = along_a_parabola([t + by / 8 for t, by in zip(times, true.tolist(), strict=True)])
    optimiser = torch.optim.Adam([offsets.values], lr=0.02)
    for _ in range(200):
        optimiser.zero_grad()
        (followed(offsets, times) - shown).square().sum().backward()
        optimiser.step()
    torch.testing.assert_close(offsets.values.detach(), true, atol=1e-3, rtol=0)


def test_control_points_with_no_offset_yet_are_as_an_even_clock_has_them() -> None:
    motion = disturbed(started("control_points", COUNT, time_offsets_from=0.5))
    tensors = motion.tensors()
    assert tensors["time_offsets"].shape == (FACTS.frames,)
    with torch.no_grad():
        tensors["time_offsets"].zero_()
        earlier = moved_by(motion, splats_of(COUNT), 9 / 19)
        tensors["time_offsets"][10] = -1.0
        found = moved_by(motion, splats_of(COUNT), 10 / 19)
    torch.testing.assert_close(found.means, earlier.means, atol=1e-6, rtol=0)


def test_before_their_progress_offsets_are_neither_followed_nor_learnt() -> None:
    motion = disturbed(started("control_points", COUNT, time_offsets_from=0.5))
    splats = splats_of(COUNT)
    later = moved_by(motion, splats, 0.3).means
    motion.advance(0.4)
    found = moved_by(motion, splats, 0.3).means
    assert not torch.equal(found, later)
    found.sum().backward()
    value = motion.penalty(Moment(splats), Instant(0.3), generator())
    assert value is not None
    value.backward()
    assert motion.tensors()["time_offsets"].grad is None
    with torch.no_grad():
        motion.tensors()["time_offsets"].zero_()
    motion.advance(0.5)
    torch.testing.assert_close(moved_by(motion, splats, 0.3).means, found, atol=1e-6, rtol=0)


@pytest.mark.parametrize("degree", [1, 3])
def test_the_offsets_of_control_points_have_the_gradient_of_the_splats_places(degree: int) -> None:
    given = {"time_offsets_from": 0.5, "time_degree": degree, "time_ratio": 1.0}
    motion = disturbed(started("control_points", COUNT, **given))
    offsets, splats = motion.tensors()["time_offsets"], splats_of(COUNT)
    weights, time, step = torch.randn(COUNT, 3, generator=generator(3)), 10 / 19, 0.25
    (moved_by(motion, splats, time).means * weights).sum().backward()
    assert offsets.grad is not None and offsets.grad.count_nonzero() == 1
    sums = []
    with torch.no_grad():
        for by in (-step, step):
            offsets[10] += by
            sums.append(float((moved_by(motion, splats, time).means.double() * weights).sum()))
            offsets[10] -= by
    slope = (sums[1] - sums[0]) / (2 * step)
    # splats turn with their points, which is not linear over half a frame
    assert float(offsets.grad[10]) == pytest.approx(slope, rel=0.02)


def test_the_rigidity_tells_offsets_nothing() -> None:
    given = {"time_offsets_from": 0.5, "time_offsets_weight": 0.0}
    motion = disturbed(started("control_points", COUNT, **given))
    value = motion.penalty(Moment(splats_of(COUNT)), Instant(0.5), generator())
    assert value is not None
    value.backward()
    slopes = motion.tensors()["time_offsets"].grad
    assert slopes is not None and not slopes.any()


def test_a_scene_of_one_moment_has_no_offsets() -> None:
    facts = replace(FACTS, frames=1)
    motion = start_motion({"name": "control_points", "time_offsets_from": 0.5}, facts, COUNT)
    assert "time_offsets" not in motion.tensors()


def test_a_report_says_how_much_later_views_are_shown() -> None:
    motion = started("control_points", COUNT, time_offsets_from=0.5)
    with torch.no_grad():
        motion.tensors()["time_offsets"][:3] = torch.tensor([0.5, -0.5, 0.25])
    camera = Camera(np.eye(4), 5.0, 6.0, 9.0, 8.0, 18, 16)
    told = motion.tell_views([(camera, 0.0), (camera, 1.5 / (FACTS.frames - 1)), (camera, 1.0)])
    assert told["time_offsets"] == pytest.approx([0.5, -0.125, 0.0], abs=1e-6)
    assert started("control_points", COUNT).tell_views([(camera, 0.0)]) == {}


def test_a_checkpoint_needs_an_offset_for_each_frame() -> None:
    motion = started("control_points", COUNT, time_offsets_from=0.5)
    (parameter,) = (p for p in motion.parameters() if p.name == "time_offsets")
    parameter.set_values(torch.zeros(FACTS.frames - 1))
    with pytest.raises(ValueError, match=r"time offsets \(19,\) for 20 frames"):
        motion.check()


def test_offsets_cost_their_mean_square() -> None:
    """Beside what the rest of the motion costs, with a weight."""
    values = []
    for weight in (0.0, 0.5):
        given = {"time_offsets_from": 0.5, "time_offsets_weight": weight}
        motion = disturbed(started("control_points", COUNT, **given))
        value = motion.penalty(Moment(splats_of(COUNT)), Instant(0.5), generator())
        assert value is not None
        values.append(value)
    mean = motion.tensors()["time_offsets"].square().mean()
    torch.testing.assert_close(values[1] - values[0], 0.5 * mean, atol=1e-6, rtol=1e-4)


@pytest.mark.usefixtures("kernels_on_the_cpu")
def test_a_gpu_has_several_frames_at_once_as_it_has_each() -> None:
    motion = disturbed(started("control_points", COUNT, time_offsets_from=0.5))
    splats, offsets = splats_of(COUNT), motion.tensors()["time_offsets"]
    instants = [Instant(time) for time in (0.1, 0.5, 0.99)]
    weights = torch.randn(COUNT, 3, generator=generator(3))
    together = motion.at_instants(Moment(splats), instants)
    alone = [motion.at(Moment(splats), instant) for instant in instants]
    slopes = []
    for moments in (together, alone):
        total = torch.stack([(moment.splats.means * weights).sum() for moment in moments]).sum()
        slopes.append(torch.autograd.grad(total, offsets)[0])
    for one, other in zip(together, alone, strict=True):
        torch.testing.assert_close(one.splats.means, other.splats.means)
    assert slopes[0].count_nonzero() > 2
    torch.testing.assert_close(slopes[0], slopes[1])
