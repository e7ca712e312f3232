"""Groups of splats that move as rigid bodies: how they are found, fitted, kept and refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import cast

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, model_of, moved_by, penalty_of, splats_of, started
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.geometry import covariance
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.motion import _taking_over
from gsdmsr_cli.model.motion._grouping import (
    align,
    fit_movements,
    group_paths,
    group_splats,
    settle,
)
from gsdmsr_cli.model.motion.rigid_groups import RigidGroups
from gsdmsr_cli.ops.skin import skin_twin, transforms_twin

AXES = [0.0, 0.0, 1.0], [0.6, 0.8, 0.0]
SHIFTS = [0.4, 0.0, 0.1], [-0.3, 0.2, 0.0]


def body_of(splats: Splats) -> Tensor:
    """Return which of two bodies splats belong to: every other one, wherever they are."""
    return torch.arange(len(splats)) % 2


def truth(splats: Splats, time: float, turn: float = 1.0) -> Splats:
    """Return splats of two bodies, each of which turns about its own axis and goes its way."""
    means, quats = splats.means.clone(), splats.quats.clone()
    for body in (0, 1):
        own = body_of(splats) == body
        rotation = Rotation.from_rotvec(turn * (time - 0.5) * torch.tensor(AXES[body]).numpy())
        shift = (time - 0.5) * torch.tensor(SHIFTS[body])
        means[own] = torch.from_numpy(rotation.apply(splats.means[own].numpy())).to(means) + shift
        turned = rotation * Rotation.from_quat(splats.quats[own].numpy(), scalar_first=True)
        quats[own] = torch.from_numpy(turned.as_quat(scalar_first=True)).to(quats)
    return replace(splats, means=means, quats=quats)


def two_bodies(count: int) -> Splats:
    """Return splats of two bodies beside each other."""
    splats = splats_of(count)
    splats.means[body_of(splats) == 1, 0] += 4 * FACTS.bound
    return splats


class Bodies(Layer):
    """A base that has learnt where two bodies go."""

    def at(self, moment: Moment, instant: Instant) -> Moment:
        return replace(moment, splats=truth(moment.splats, instant.time))


def same_shape(found: Splats, expected: Splats, tolerance: float) -> None:
    torch.testing.assert_close(found.means, expected.means, atol=tolerance, rtol=0)
    shapes = [covariance(s.quats, s.log_scales) for s in (found, expected)]
    torch.testing.assert_close(*shapes, atol=tolerance, rtol=0)


def moved(splats: Splats, anchors: Tensor, movement: Tensor, group: Tensor) -> Splats:
    """Return the splats after the movements (J, 10) of their groups."""
    radii = anchors.new_zeros(len(anchors))
    return skin_twin(splats, anchors, radii, transforms_twin(anchors, movement), group[:, None])


def test_the_movement_of_a_group_is_found_from_its_splats() -> None:
    """Of a group of many, of one of a single splat, which turns too, and of one of none."""
    before = splats_of(20).map(Tensor.double)
    rotation = Rotation.from_rotvec([1.0, -2.0, 0.5])
    turned = rotation * Rotation.from_quat(before.quats.numpy(), scalar_first=True)
    after = replace(
        before,
        means=torch.from_numpy(rotation.apply(before.means.numpy())) + 0.3,
        quats=-2 * torch.from_numpy(turned.as_quat(scalar_first=True)),
    )
    group, anchors = torch.tensor([0] * 19 + [2]), torch.randn(3, 3).double()
    weights = torch.rand(20, generator=generator()).double() + 0.1
    movement = fit_movements(before, after, group, weights, anchors)
    same_shape(moved(before, anchors, movement, group), after, 1e-8)
    assert not movement[1].any()


def test_splats_that_lie_among_each_other_are_told_apart_by_where_they_go() -> None:
    splats = splats_of(200)
    paths = torch.stack([truth(splats, i / 7, turn=0).means for i in range(8)])
    paths[:, 1::2] += torch.linspace(0, 8, 8)[:, None, None]
    found = group_paths(paths, torch.arange(20), 1)[:, 0]
    assert torch.equal(found % 2, body_of(splats))
    first = torch.cdist(paths[0], paths[0, :20]).argmin(dim=1)
    assert not torch.equal(first % 2, body_of(splats))


def test_the_nearest_path_is_half_its_mean_distance_and_half_its_scatter() -> None:
    paths = torch.zeros(2, 3, 3)
    paths[:, 0, 0] = torch.tensor([2.0, 2.0])  # mean 2, scatter 0
    paths[:, 1, 0] = torch.tensor([0.1, 3.1])  # mean 1.6, scatter 1.5
    assert group_paths(paths, torch.tensor([0, 1]), 2)[2].tolist() == [0, 1]
    paths[1, 0, 0] = 4.0  # mean 3, scatter 1
    assert group_paths(paths, torch.tensor([0, 1]), 2)[2].tolist() == [1, 0]


def test_a_splat_joins_the_group_whose_movement_fits_it() -> None:
    """Where two bodies touch, the nearest group may be of the other one."""
    before = splats_of(80)
    then = [truth(before, i / 7) for i in range(8)]
    anchors, body = before.means[:2], body_of(before)
    near = torch.stack([body, 1 - body], dim=1)
    near[:20] = near[:20].flip(1)  # a quarter begins wrong
    found = group_splats(before, then, near, torch.ones(80), anchors)
    assert torch.equal(found, body)


def test_what_is_not_rigid_is_wrong_a_little_at_all_times() -> None:
    """Of a body that grows to twice its size while it turns: of one in between."""
    sizes, whole = torch.linspace(1, 2, 8).double(), splats_of(30).map(Tensor.double)
    turns = Rotation.from_rotvec([[0.0, 0.3 * i, 0.0] for i in range(8)]).as_matrix()
    then = [
        replace(
            whole,
            means=size * whole.means @ torch.from_numpy(turn).T,
            log_scales=whole.log_scales + size.log(),
        )
        for size, turn in zip(sizes, turns, strict=True)
    ]
    group, anchors = torch.zeros(30, dtype=torch.int64), torch.zeros(1, 3).double()
    found = settle(then[0], then, group, torch.ones(30).double(), anchors)
    expected = torch.pdist(whole.means) * sizes.mean()
    torch.testing.assert_close(torch.pdist(found.means), expected, rtol=1e-2, atol=0)
    torch.testing.assert_close(found.log_scales, whole.log_scales + sizes.mean().log())


def test_a_full_turn_goes_on_smoothly_between_keyframes() -> None:
    """Where quaternions pass from one sign to the other."""
    angles = torch.linspace(-math.pi, math.pi, 17)
    keys = torch.zeros(17, 1, 10)
    keys[:, 0, 3], keys[:, 0, 6] = (angles / 2).cos() - 1, (angles / 2).sin()
    flipped = keys.clone()
    flipped[::3, 0, 3:7] = -flipped[::3, 0, 3:7] - torch.tensor([2.0, 0, 0, 0])
    torch.testing.assert_close(align(flipped, 8), keys)


class Swaying(Bodies):
    """A base that has also learnt how splats sway and swell, each by its own amount."""

    def at(self, moment: Moment, instant: Instant) -> Moment:
        splats, rng = super().at(moment, instant).splats, generator(8)
        phase = 2 * math.pi * instant.time
        sway, swell = (0.1 * torch.randn(splats.means.shape, generator=rng) for _ in range(2))
        means, log_scales = splats.means.clone(), splats.log_scales + 5 * swell * math.cos(phase)
        means += sway * splats.log_scales.exp() * math.sin(phase)
        return replace(moment, splats=replace(splats, means=means, log_scales=log_scales))


def distilled(
    splats: int = 60, base: Layer | None = None, /, **options: int
) -> tuple[RigidGroups, Splats]:
    """Return groups that have taken over from two bodies, and their canonical splats."""
    settings = {"count": 6, "base": {"name": "multiscale"}} | options
    motion = cast(RigidGroups, started("rigid_groups", splats, **settings))
    motion.base, base = base or Bodies(), motion.base
    settled, dropped = motion.distil(two_bodies(splats))
    assert base is not None and set(dropped) == {f"base.{name}" for name in base.tensors()}
    return motion, settled


def test_groups_move_as_the_motion_does_that_they_take_over_from() -> None:
    """As two bodies move, which are six groups: exactly at keyframes, and nearly in between."""
    motion, splats = distilled()
    same_shape(splats, truth(two_bodies(60), 0.5), 1e-6)
    frames = len(motion.keys) - 1
    for time in (0.0, 3 / frames, 1.0, 0.512, 7.5 / frames):
        tolerance = 1e-5 if (time * frames) % 1 < 1e-6 else 3e-3
        same_shape(moved_by(motion, splats, time), truth(two_bodies(60), time), tolerance)


def test_series_say_what_groups_leave() -> None:
    """What is the same for all splats but for its amount takes as many series as there are such."""
    truths = {time: moved_by(Swaying(), two_bodies(60), time) for time in (0.0, 0.15, 0.5)}

    def error(series: int) -> float:
        motion, splats = distilled(60, Swaying(), series=series)
        off = 0.0
        for time, expected in truths.items():
            found = moved_by(motion, splats, time).detach()
            size = expected.log_scales.exp().mean(dim=1, keepdim=True)
            off += float(((found.means - expected.means) / size).square().mean())
            off += float((found.log_scales - expected.log_scales).square().mean())
        return off

    assert error(8) < 1e-2 * error(0)


def test_splats_that_do_more_than_their_groups_do_not_follow_them_alone() -> None:
    assert distilled()[0].following() is not None
    assert distilled(60, Swaying(), series=3)[0].following() is None


def in_double(motion: RigidGroups) -> RigidGroups:
    """Return the motion with numbers of 64 bits, which plain torch serves."""
    for parameter in motion.parameters():
        if parameter.tensor.dtype == torch.float32:
            parameter.set_values(parameter.tensor.double())
    return motion


def test_what_a_splat_does_of_its_own_goes_with_its_group() -> None:
    """In numbers of 64 bits, against products; and its gradients."""
    motion, splats = distilled(7, Swaying(), series=3)
    motion, splats = in_double(motion), splats.map(Tensor.double)
    place = 0.33 * (len(motion.keys) - 1)
    keys, row = (
        (1 - place % 1) * tensor[int(place)] + place % 1 * tensor[int(place) + 1]
        for tensor in (motion.keys, motion.series)
    )
    own = torch.einsum("k,nkc->nc", row, motion.shares)
    means, log_scales = splats.means + own[:, :3], splats.log_scales + own[:, 3:]
    before = replace(splats, means=means, log_scales=log_scales)
    expected = moved(before, motion.anchors, keys, motion.group[:, 0].long())
    found = moved_by(motion, splats, 0.33)
    for name, tensor in expected.tensors().items():
        torch.testing.assert_close(found.tensors()[name], tensor, rtol=1e-9, atol=1e-12)

    def shown(shares: Tensor) -> tuple[Tensor, ...]:
        motion.shares = shares
        after = moved_by(motion, splats, 0.33)
        return after.means, after.log_scales

    assert torch.autograd.gradcheck(shown, motion.shares.detach().clone().requires_grad_())


def test_shares_follow_their_splats() -> None:
    motion, splats = distilled(60, Swaying(), series=3)
    rows = torch.tensor([8, 8, 59, 0])
    expected = moved_by(motion, splats, 0.7).take(rows)
    motion.take(rows, torch.tensor([False, True, False, False]))
    found = moved_by(motion, splats.take(rows), 0.7)
    assert torch.equal(found.means, expected.means)
    assert torch.equal(found.log_scales, expected.log_scales)


def test_there_are_no_more_groups_than_splats() -> None:
    motion, splats = distilled(9, count=50)
    assert len(motion.anchors) == motion.keys.shape[1] == 9
    same_shape(moved_by(motion, splats, 1.0), truth(two_bodies(9), 1.0), 1e-5)


def test_what_has_been_taken_over_from_leaves_nothing() -> None:
    motion, _ = distilled()
    base = {n: t for n, t in motion.tensors().items() if n.startswith("base.")}
    assert base and not any(tensor.numel() for tensor in base.values())
    assert len(base["base.embeddings"]) == 60  # rows go on, for whatever has rows of splats
    motion.take(torch.tensor([3, 3, 5]), torch.tensor([False, True, False]))
    assert len(motion.tensors()["base.embeddings"]) == len(motion.group) == 3


@pytest.mark.parametrize("series", [0, 2])
def test_groups_that_have_taken_over_are_restored(series: int) -> None:
    motion, splats = distilled(60, Swaying(), series=series)
    model = model_of(splats, motion)
    tensors = {name: tensor.detach().clone() for name, tensor in model.tensors().items()}
    base = {"name": "multiscale"}
    settings = {"name": "rigid_groups", "count": 9, "series": series, "base": base}
    loaded = load_model(tensors, settings, (), FACTS, 1.0)
    found, expected = (one.at(one.instant(0.3)).splats for one in (loaded, model))
    for name, tensor in expected.tensors().items():
        assert torch.equal(found.tensors()[name], tensor), name
    with pytest.raises(DataError, match="of other groups than there are, 6"):
        load_model(tensors | {"motion.group": tensors["motion.group"] + 6}, settings, (), FACTS, 1)
    with pytest.raises(DataError, match="anchors and keyframes of shapes"):
        load_model(tensors | {"motion.anchors": torch.zeros(5, 3)}, settings, (), FACTS, 1)
    if series:
        with pytest.raises(DataError, match=r"series and shares of shapes .* for 20 keyframes"):
            load_model(tensors | {"motion.series": torch.zeros(20, 3)}, settings, (), FACTS, 1)


def test_until_then_the_base_is_the_motion() -> None:
    base = {"name": "multiscale", "embedding_weight": 2.0}
    motion = started("rigid_groups", 5, base=base)
    alone = started("multiscale", 5, embedding_weight=2.0)
    for one in (motion, alone):
        one.advance(1.0)
        rng = generator(3)
        with torch.no_grad():
            for parameter in one.parameters():
                if parameter.name.removeprefix("base.") in alone.tensors():
                    noise = torch.randn(parameter.tensor.shape, generator=rng)
                    parameter.tensor.add_(0.1 * noise)
    splats = splats_of(5)
    assert torch.equal(moved_by(motion, splats, 0.3).means, moved_by(alone, splats, 0.3).means)
    found, expected = (penalty_of(one, splats, 0.3, generator()) for one in (motion, alone))
    assert found is not None and expected is not None and torch.equal(found, expected)
    rows = torch.tensor([4, 4, 1])
    for one in (motion, alone):
        one.take(rows, torch.zeros(3, dtype=torch.bool))
    after = splats.take(rows)
    assert torch.equal(moved_by(motion, after, 0.9).means, moved_by(alone, after, 0.9).means)


def test_without_a_base_groups_are_where_splats_are_as_motion_begins() -> None:
    motion = cast(RigidGroups, started("rigid_groups", 50, count=5))
    splats = splats_of(50, seed=3)
    motion.reanchor(splats)
    near = torch.cdist(splats.means, motion.anchors).argmin(dim=1)
    assert torch.equal(motion.group[:, 0].long(), near)
    with torch.no_grad():
        motion.keys += 0.1
    before = motion.anchors.clone()
    motion.reanchor(splats_of(50))
    assert torch.equal(motion.anchors, before)


def test_smoothness_is_the_mean_squared_second_difference() -> None:
    motion = cast(RigidGroups, started("rigid_groups", 5, count=2, smoothness=3.0))
    with torch.no_grad():
        motion.keys.copy_(torch.arange(20.0).square()[:, None, None].expand_as(motion.keys))
    penalty = penalty_of(motion, splats_of(5), 0.3, generator())
    assert penalty is not None and penalty.item() == pytest.approx(3.0 * 10 * 2.0**2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count is 0; allowed: 1 or more"),
        ({"series": -1}, "series is -1; allowed: 0 or more"),
        ({"series": 2}, "series is 2; allowed: 0, unless there is a base"),
        ({"time_ratio": 0}, "time_ratio is 0.0; allowed: a number above 0"),
        ({"smoothness": -1}, "smoothness is -1.0; allowed: 0 or more"),
        ({"rate": [1e-3, 0]}, r"rate is .*; allowed: \[start, end\], both above 0"),
        ({"base": {}}, "base is .*; allowed: null or another motion's name and options"),
        ({"base": {"name": "rigid_groups"}}, "base is .*; allowed: null or another motion's name"),
        ({"base": {"name": "hexplan"}}, "unknown motion 'hexplan'; did you mean 'hexplane'"),
        ({"base": {"name": "hexplane", "widht": 16}}, "unknown key 'widht'; did you mean 'width'"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        started("rigid_groups", 5, **options)


class Fading(Layer):
    """Changes what groups do not carry."""

    def at(self, moment: Moment, instant: Instant) -> Moment:
        splats = moment.splats
        faded = replace(splats, logit_opacities=splats.logit_opacities - instant.time)
        return replace(moment, splats=faded, features=torch.zeros(len(splats), 1))


def test_a_base_that_does_more_than_to_move_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_taking_over, "start_layer", lambda *_: Fading())
    told = r"^motion\.base is 'hexplane', which has features and logit_opacities of its own; only"
    with pytest.raises(UsageError, match=told):
        started("rigid_groups", 5, base={"name": "hexplane"})
