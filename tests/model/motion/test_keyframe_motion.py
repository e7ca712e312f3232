"""Keyframes: the closed forms of curves and arcs, gradients, their number, and bad options."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from motion_checks import FACTS, disturbed, moved_by, penalty_of, splats_of, started
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layer import Instant, Layer, options_of
from gsdmsr_cli.model.motion._arcs import slerp
from gsdmsr_cli.model.motion.keyframes import Options

COUNT, KEYFRAMES = 5, 4
TIMES = (0.0, 0.2, 1 / 3, 0.5, 0.83, 1.0)


def in_float64(**options: int) -> Layer:
    motion = disturbed(started("keyframes", COUNT, keyframes=KEYFRAMES, **options))
    for parameter in motion.parameters():
        parameter.set_values(parameter.tensor.double())
    return motion


@torch.no_grad()
def test_positions_are_cubic_hermite_curves_through_the_keyframes() -> None:
    motion, splats = in_float64(), splats_of(COUNT).map(Tensor.double)
    keys = FACTS.bound * motion.tensors()["offsets"].numpy()
    slopes = (keys[:, 2:] - keys[:, :-2]) / 2
    curve = CubicHermiteSpline(np.arange(KEYFRAMES), keys[:, 1:-1], slopes, axis=1)
    for time in TIMES:
        found = (moved_by(motion, splats, time).means - splats.means).numpy()
        expected = curve(time * (KEYFRAMES - 1))
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-13)


@torch.no_grad()
def test_rotations_are_arcs_between_keyframes_before_the_own_rotation() -> None:
    """To 1e-4, from which on chords are taken for arcs."""
    motion, splats = in_float64(), splats_of(COUNT).map(Tensor.double)
    motion.tensors()["turns"].mul_(5)
    keys = (motion.tensors()["turns"] + torch.tensor([1.0, 0, 0, 0])).numpy()
    for time in TIMES:
        found = moved_by(motion, splats, time).quats.numpy()
        for i in range(COUNT):
            arcs = Slerp(np.arange(KEYFRAMES), Rotation.from_quat(np.roll(keys[i], -1, axis=1)))
            own = Rotation.from_quat(np.roll(splats.quats[i].numpy(), -1))
            expected = (arcs(time * (KEYFRAMES - 1)) * own).as_matrix()
            matrix = Rotation.from_quat(np.roll(found[i], -1)).as_matrix()
            np.testing.assert_allclose(matrix, expected, atol=2e-4)


@torch.no_grad()
def test_a_line_through_keyframes_is_a_line() -> None:
    motion, splats = in_float64(), splats_of(COUNT).map(Tensor.double)
    steps = torch.arange(KEYFRAMES + 2).double()[None, :, None] - 1
    motion.tensors()["offsets"].copy_(steps * torch.randn(COUNT, 1, 3).double())
    first, last = (moved_by(motion, splats, time).means for time in (0.0, 1.0))
    for time in TIMES:
        expected = torch.lerp(first, last, time)
        torch.testing.assert_close(moved_by(motion, splats, time).means, expected)


def test_opposite_quaternions_are_the_same_rotation() -> None:
    first = torch.tensor([[0.0, 0.2, 0.1, 0.0]])
    opposite = -(first + torch.tensor([1.0, 0, 0, 0])) - torch.tensor([1.0, 0, 0, 0])
    one = slerp(first, opposite, 0.5)
    torch.testing.assert_close(one, slerp(first, first, 0.5))


@pytest.mark.parametrize("time", [0.21, 1.0])
def test_its_gradients_are_right(time: float) -> None:
    motion, splats = in_float64(), splats_of(COUNT).map(Tensor.double)

    def moved(offsets: Tensor, turns: Tensor, quats: Tensor) -> tuple[Tensor, Tensor]:
        motion.offsets, motion.turns = offsets, turns
        splats.quats.data = quats.data
        after = motion.at(Moment(splats), Instant(time)).splats
        return after.means, after.quats

    given = [t.detach().clone().requires_grad_() for t in motion.tensors().values()]
    assert torch.autograd.gradcheck(lambda *own: moved(*own, splats.quats), given)


def test_keyframes_are_to_lie_near_the_first() -> None:
    motion = disturbed(started("keyframes", COUNT, keyframes=KEYFRAMES, nearness=3.0))
    offsets = motion.tensors()["offsets"].detach().double().numpy()
    expected = 3 * np.linalg.norm(offsets[:, 1:] - offsets[:, :1], axis=2).mean()
    found = penalty_of(motion, splats_of(COUNT), 0.4, torch.Generator())
    assert found is not None and found.item() == pytest.approx(expected, rel=1e-5)


def test_their_number_follows_from_the_frames_unless_it_is_given() -> None:
    assert [Options().count(frames) for frames in (1, 2, 11, 12, 300)] == [2, 2, 2, 3, 31]
    assert Options(interval=5).count(50) == 11 and Options(keyframes=7).count(300) == 7
    assert started("keyframes", 3).tensors()["turns"].shape == (3, 3, 4)  # of 20 frames


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("keyframes", 1, "null or 2 or more"),
        ("interval", 0, "1 or more"),
        ("nearness", -1, "0 or more"),
        ("rate", [0, 1e-3], r"\[start, end\], both above 0"),
        ("turn_rate", [1e-3, -1], r"\[start, end\], both above 0"),
    ],
)
def test_options_out_of_range_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"^motion: {option} is .*; allowed: {allowed}$"):
        options_of(motions.__name__, {"name": "keyframes", option: value})
