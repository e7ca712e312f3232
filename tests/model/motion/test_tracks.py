"""Tracks: where splats are at the moments, between them, and where a moment begins."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, moved_by, splats_of
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.model.layer import options_of
from gsdmsr_cli.model.motion.tracks import Options, Tracks

COUNT, TIMES = 5, (0.1, 0.2, 0.5, 0.6)


def rotations(seed: int) -> Rotation:
    return Rotation.random(COUNT, random_state=seed)


def quats_of(rotation: Rotation) -> Tensor:
    return torch.from_numpy(np.roll(rotation.as_quat(), 1, axis=1)).float()


def saved(times: tuple[float, ...] = TIMES) -> dict[str, Tensor]:
    """The tensors of tracks at so many moments, of random places and turns."""
    rng, later = generator(3), len(times) - 1
    offsets = torch.randn(COUNT, later, 3, generator=rng)
    quats = torch.stack([quats_of(rotations(i)) for i in range(later)], dim=1)
    turns = quats - torch.tensor([1.0, 0, 0, 0])
    return {
        "offsets": offsets[:, -1], "turns": turns[:, -1],
        "past_offsets": offsets[:, :-1], "past_turns": turns[:, :-1],
        "times": torch.tensor(times, dtype=torch.float64),
    }  # fmt: skip


def restored(tensors: dict[str, Tensor]) -> Tracks:
    tracks = Tracks(Options(), FACTS, COUNT)
    tracks.restore(tensors, COUNT)
    return tracks


def test_at_each_moment_splats_are_where_its_offsets_and_turns_take_them() -> None:
    tensors, splats = saved(), splats_of(COUNT)
    tracks = restored(tensors)
    offsets = torch.cat([tensors["past_offsets"], tensors["offsets"][:, None]], dim=1)
    for i, time in enumerate(TIMES[1:]):
        moved = moved_by(tracks, splats, time)
        expected = splats.means + FACTS.bound * offsets[:, i]
        torch.testing.assert_close(moved.means, expected, rtol=0, atol=1e-6)
        turned = quat_product(quats_of(rotations(i)), splats.quats)
        torch.testing.assert_close(moved.quats, turned, rtol=0, atol=1e-5)
        assert moved.log_scales is splats.log_scales and moved.sh is splats.sh


@pytest.mark.parametrize("time", [0.0, 0.05, 0.1])
def test_up_to_the_first_moment_splats_are_as_they_are_stored(time: float) -> None:
    splats = splats_of(COUNT)
    moved = moved_by(restored(saved()), splats, time)
    assert torch.equal(moved.means, splats.means) and torch.equal(moved.quats, splats.quats)


def test_after_the_newest_moment_splats_stay() -> None:
    tracks, splats = restored(saved()), splats_of(COUNT)
    last, later = (moved_by(tracks, splats, time) for time in (TIMES[-1], 0.97))
    assert torch.equal(last.means, later.means) and torch.equal(last.quats, later.quats)


@pytest.mark.parametrize("u", [0.25, 0.5, 0.9])
def test_between_two_moments_splats_go_straight_and_turn_on_arcs(u: float) -> None:
    tracks, splats = restored(saved()), splats_of(COUNT)
    moved = moved_by(tracks, splats, TIMES[1] + u * (TIMES[2] - TIMES[1]))
    ends = [moved_by(tracks, splats, time).means for time in TIMES[1:3]]
    torch.testing.assert_close(moved.means, torch.lerp(*ends, u), rtol=0, atol=1e-5)
    for row, own in enumerate(quats_of(Rotation.identity(COUNT))):
        arc = Slerp([0, 1], Rotation.concatenate([rotations(0)[row], rotations(1)[row]]))
        expected = quats_of(Rotation.concatenate([arc(u)] * COUNT))[row]
        found = quat_product(moved.quats[row], splats.quats[row] * torch.tensor([1.0, -1, -1, -1]))
        found = found / splats.quats[row].square().sum()
        assert abs(float((found * expected).sum())) == pytest.approx(1, abs=1e-4), own


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_moment_begins_where_the_last_velocity_leads(share: float) -> None:
    """Over 0.3 at what was covered in 0.1: three times as far, times the share."""
    tracks = Tracks(Options(), FACTS, COUNT)
    tracks.offsets.requires_grad_(False)
    one, two = torch.full((COUNT, 3), 0.2), torch.full((COUNT, 3), 0.3)
    tracks.go_on(0.1, 0.1, 0.2, share)
    assert not tracks.offsets.any()
    tracks.offsets.copy_(one)
    tracks.go_on(0.1, 0.2, 0.3, share)
    torch.testing.assert_close(tracks.offsets, one + share * one)
    tracks.offsets.copy_(two)
    tracks.go_on(0.1, 0.3, 0.6, share)
    torch.testing.assert_close(tracks.offsets, two + 3 * share * (two - one))
    assert torch.equal(tracks.past_offsets[:, 0], two)
    assert tracks.times.tolist() == [0.1, 0.3, 0.6]
    splats = splats_of(COUNT)
    moved = moved_by(tracks, splats, 0.3).means
    torch.testing.assert_close(moved, splats.means + FACTS.bound * two)


def test_settling_leaves_the_rotations_and_makes_quaternions_of_length_one() -> None:
    tracks, splats = restored(saved()), splats_of(COUNT)
    tracks.turns.requires_grad_(False)
    tracks.turns.copy_(3 * (tracks.turns + torch.tensor([1.0, 0, 0, 0])))
    tracks.turns.sub_(torch.tensor([1.0, 0, 0, 0]))
    before = moved_by(tracks, splats, 1.0).quats
    tracks.settle(splats, first=False)
    torch.testing.assert_close(moved_by(tracks, splats, 1.0).quats, before)
    lengths = (tracks.turns + torch.tensor([1.0, 0, 0, 0])).norm(dim=1)
    torch.testing.assert_close(lengths, torch.ones(COUNT))


def test_tracks_of_any_number_of_moments_are_restored() -> None:
    for count in (2, 3, 7):
        times = tuple(i / 6 for i in range(count))
        tensors = saved(times)
        tracks = restored(tensors)
        for name, tensor in tracks.tensors().items():
            assert torch.equal(tensor, tensors[name])


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("times", torch.tensor([0.1, 0.2, 0.5], dtype=torch.float64), "and 3 times"),
        ("times", torch.tensor([0.1, 0.6, 0.5, 0.7], dtype=torch.float64), "do not ascend"),
        ("past_turns", torch.zeros(COUNT, 1, 4), "tracks of 2 and 1 moments"),
        ("past_offsets", torch.zeros(COUNT + 1, 2, 3), "for 'past_offsets'"),
        ("offsets", torch.zeros(COUNT, 4), "for 'offsets'"),
    ],
)
def test_what_does_not_fit_together_is_refused(name: str, wrong: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        restored(saved() | {name: wrong})


def test_rates_are_above_zero() -> None:
    settings = {"name": "tracks", "rate": [0.0, 1e-4]}
    with pytest.raises(UsageError, match="both above 0"):
        options_of("gsdmsr_cli.model.motion", settings)
