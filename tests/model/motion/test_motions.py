"""What every motion must keep to, over all files of the folder, and what is each one's own."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from functools import cache

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import generator
from motion_checks import (
    FACTS,
    are_among,
    disturbed,
    model_of,
    moved_by,
    penalty_of,
    splats_of,
    start_motion,
    started,
)
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layer import Facts, Instant, Layer, options_of
from gsdmsr_cli.model.motion._control_points import ControlPoints
from gsdmsr_cli.model.motion._decoder_smoothness import ROWS
from gsdmsr_cli.ops import hash_grid
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.ops.hash_grid import lookup_twin as lookup_hashed_twin
from gsdmsr_cli.ops.planes import CUBE, Level, lookup_twin, penalty_twin
from gsdmsr_cli.training.rates import NAMED

TIMES = (0.0, 0.3, 1.0)
COUNT = 7

every_motion = pytest.mark.parametrize("name", plugins.names(motions.__name__))
every_grid = pytest.mark.parametrize("name", ["hexplane", "multiscale", "control_points"])


WRONG = (
    ("levels", [], "1 to 8 whole numbers, each 2 or more"),
    ("levels", [16] * 9, "1 to 8 whole numbers, each 2 or more"),
    ("levels", [16, 1], "1 to 8 whole numbers, each 2 or more"),
    ("channels", 0, "a multiple of 16, 16 or more"),
    ("channels", 24, "a multiple of 16, 16 or more"),
    ("width", 8, "a multiple of 16, 16 or more"),
)
"""Options that no kernel serves, and what is allowed."""


def assert_equal(found: Splats, expected: Splats, **tolerance: float) -> None:
    for name, tensor in found.tensors().items():
        truth = expected.tensors()[name]
        if tolerance:
            torch.testing.assert_close(tensor, truth, **tolerance, msg=name)
        else:
            assert torch.equal(tensor, truth), name


@cache
def learnt(name: str) -> Layer:
    """Return a motion that moves; to be copied by whoever resizes it."""
    return disturbed(started(name, COUNT))


def weighted_sum(splats: Splats) -> Tensor:
    """Return a scalar that depends on every value of the splats, each with its own weight."""
    rng, parts = generator(5), []
    for tensor in splats.tensors().values():
        parts.append((tensor * torch.randn(tensor.shape, generator=rng)).sum())
    return torch.stack(parts).sum()


def taken(motion: Layer, rows: Tensor) -> None:
    """Let a motion follow a resize without clones or children."""
    motion.take(rows, torch.zeros_like(rows, dtype=torch.bool))


def test_the_known_motions_are_found() -> None:
    assert {"static", "hexplane", "multiscale", "control_points"} <= set(
        plugins.names(motions.__name__)
    )


@every_motion
def test_starts_as_the_identity(name: str) -> None:
    splats = splats_of(COUNT)
    for progress in (0.0, 1.0):
        motion = started(name, COUNT)
        motion.advance(progress)
        for time in TIMES:
            moved = moved_by(motion, splats, time)
            if motion.identity_at_start:
                assert_equal(moved, splats)
            assert len(moved) == COUNT


def test_every_motion_so_far_says_that_it_starts_as_the_identity() -> None:
    known = ("static", "hexplane", "multiscale", "control_points")
    assert all(started(name).identity_at_start for name in known)


@every_motion
def test_several_times_at_once_are_those_times_to_the_last_bit(name: str) -> None:
    motion, splats = disturbed(started(name, COUNT)), splats_of(COUNT)
    instants = [Instant(time) for time in TIMES]
    for progress in (0.0, 1.0):
        motion.advance(progress)
        found = motion.at_instants(Moment(splats), instants)
        for instant, moment in zip(instants, found, strict=True):
            alone = motion.at(Moment(splats), instant)
            assert_equal(moment.splats, alone.splats)
            for further in ("axes", "features"):
                own, expected = getattr(moment, further), getattr(alone, further)
                assert expected is None if own is None else torch.equal(own, expected)
    taken(motion, torch.arange(0))
    found = motion.at_instants(Moment(splats_of(0)), instants)
    assert [len(moment) for moment in found] == [0, 0, 0]


@every_motion
def test_holding_what_is_not_shown_changes_nothing_that_is(name: str) -> None:
    motion, splats = disturbed(started(name, COUNT)), splats_of(COUNT)
    model = model_of(splats, motion)
    before = [moved_by(motion, splats, time) for time in (0.4, 0.5, 0.6)]
    model.hold_outside(0.4, 0.6)
    for time, expected in zip((0.4, 0.5, 0.6), before, strict=True):
        assert_equal(moved_by(motion, splats, time), expected, rtol=1e-5, atol=1e-6)


@every_grid
def test_grids_stand_still_at_times_that_are_not_shown(name: str) -> None:
    motion, splats = disturbed(started(name, COUNT)), splats_of(COUNT)
    model_of(splats, motion).hold_outside(0.4, 0.6)
    for ends in ((0.8, 1.0), (0.0, 0.2)):
        one, other = (moved_by(motion, splats, time) for time in ends)
        assert_equal(one, other, rtol=1e-5, atol=1e-6)
    assert not torch.allclose(one.means, moved_by(motion, splats, 0.6).means)


@every_motion
def test_moves_once_it_has_learnt(name: str) -> None:
    """So that the other tests compare something; only ``static`` has nothing to learn."""
    splats = splats_of(COUNT)
    motion = disturbed(started(name, COUNT))
    at_times = [moved_by(motion, splats, time) for time in TIMES]
    assert all(t.isfinite().all() for moved in at_times for t in moved.tensors().values())
    assert (name == "static") == all(torch.equal(m.means, splats.means) for m in at_times)
    assert (name == "static") == (not motion.tensors())


@every_motion
@given(rows=st.lists(st.integers(0, COUNT - 1), max_size=20), time=st.floats(0, 1, width=32))
@settings(max_examples=15, deadline=None)
def test_resize_then_move_is_move_then_resize(name: str, rows: list[int], time: float) -> None:
    """Rows may repeat (clone, split), be absent (prune) or change places (reorder)."""
    wanted = torch.tensor(rows, dtype=torch.long)
    splats, motion = splats_of(COUNT), copy.deepcopy(learnt(name))
    expected = moved_by(motion, splats, time).take(wanted)
    taken(motion, wanted)
    assert_equal(moved_by(motion, splats.take(wanted), time), expected, atol=1e-6, rtol=1e-6)


@every_motion
def test_gradients_reach_everything_that_is_trained(name: str) -> None:
    splats = splats_of(50).map(torch.nn.Parameter)
    motion = disturbed(started(name, 50))
    trained = {p.name: p.tensor for p in motion.parameters() if p.rate is not None}
    loss = torch.stack([weighted_sum(moved_by(motion, splats, time)) for time in TIMES]).sum()
    loss.backward()
    for what, tensor in {**splats.tensors(), **trained}.items():
        assert tensor.requires_grad, what
        assert tensor.grad is not None and tensor.grad.isfinite().all(), what
        assert tensor.grad.any(), what


@every_motion
def test_parameters_have_names_of_their_own_and_learning_rates(name: str) -> None:
    parameters = started(name, COUNT).parameters()
    assert len({parameter.name for parameter in parameters}) == len(parameters)
    for parameter in parameters:
        own = isinstance(parameter.rate, tuple)
        assert parameter.rate is None or own or parameter.rate in NAMED, parameter.name
        assert parameter.tensor.requires_grad == (parameter.rate is not None), parameter.name
        assert parameter.tensor.is_contiguous(), parameter.name
        assert not parameter.per_splat or len(parameter.tensor) == COUNT, parameter.name


@every_motion
def test_penalty_is_a_finite_scalar_that_can_be_learnt_from(name: str) -> None:
    motion = disturbed(started(name, COUNT))
    penalty = penalty_of(motion, splats_of(COUNT), 0.4, generator())
    if penalty is None:
        return
    assert penalty.shape == () and penalty.isfinite() and penalty > 0
    penalty.backward()
    assert any(t.grad is not None and t.grad.any() for t in motion.tensors().values())


@every_motion
def test_tensors_keep_their_names_and_order(name: str) -> None:
    motion = started(name, COUNT)
    before = list(motion.tensors())
    assert list(disturbed(started(name, COUNT)).tensors()) == before
    moved_by(motion, splats_of(COUNT), 0.5)
    taken(motion, torch.tensor([0, 2]))
    assert list(motion.tensors()) == before


@every_motion
def test_an_unknown_option_is_refused_with_the_nearest(name: str) -> None:
    with pytest.raises(UsageError, match="no_such_option"):
        started(name, no_such_option=3)


def test_a_misspelt_option_or_name_is_answered_with_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"chanels.*did you mean 'channels'"):
        started("hexplane", chanels=16)
    with pytest.raises(UsageError, match=r"unknown motion 'hexplan'; did you mean 'hexplane'\?"):
        started("hexplan")
    with pytest.raises(UsageError, match="unknown motion ''"):
        start_motion({}, FACTS, 1)


@every_grid
def test_times_outside_are_those_at_the_ends(name: str) -> None:
    splats, motion = splats_of(COUNT), disturbed(started(name))
    assert_equal(moved_by(motion, splats, 1.6), moved_by(motion, splats, 1.0))
    assert_equal(moved_by(motion, splats, -0.5), moved_by(motion, splats, 0.0))


@every_grid
@pytest.mark.parametrize("time", [0.0, 1.0])
def test_time_is_mapped_over_the_whole_grid(name: str, time: float) -> None:
    """At either end of time only that end of the temporal planes is read."""
    motion = disturbed(started(name))
    weighted_sum(moved_by(motion, splats_of(COUNT), time)).backward()
    planes = {n: t.grad for n, t in motion.tensors().items() if n.endswith(".time")}
    assert planes
    end = -1 if time else 0
    for what, gradient in planes.items():
        assert gradient is not None, what
        read = gradient.abs().sum(dim=(0, 1, 3, 4)) > 0
        assert read[end] and int(read.sum()) == 1, what


@pytest.mark.parametrize("name", ["hexplane", "multiscale"])
def test_detach_keeps_the_field_out_of_the_positions_gradient(name: str) -> None:
    splats = splats_of(COUNT).map(torch.nn.Parameter)
    motion = disturbed(started(name, detach=True))
    moved_by(motion, splats, 0.3).means.sum().backward()
    assert torch.equal(splats.means.grad, torch.ones_like(splats.means))


def gradients_before_and_after(motion: Layer, progress: tuple[float, float]) -> list[set[str]]:
    """Return the names of the tensors that get a gradient at each progress."""
    reached = []
    for now in progress:
        motion.advance(now)
        loss = weighted_sum(moved_by(motion, splats_of(COUNT), 0.3))
        penalty = penalty_of(motion, splats_of(COUNT), 0.3, generator())
        assert penalty is not None
        (loss + penalty).backward()
        tensors = motion.tensors()
        reached.append({name for name, tensor in tensors.items() if tensor.grad is not None})
        for tensor in tensors.values():
            tensor.grad = None
    return reached


def test_multiscale_freezes_the_fine_field_before_coarse_until() -> None:
    motion = disturbed(started("multiscale", coarse_until=0.25))
    coarse, both = gradients_before_and_after(motion, (0.2, 0.25))
    assert coarse and all(name.startswith("coarse") for name in coarse)
    assert both == set(motion.tensors())


def test_multiscale_moves_positions_only_while_coarse() -> None:
    splats, motion = splats_of(COUNT), disturbed(started("multiscale", coarse_until=0.25))
    motion.advance(0.1)
    coarse = moved_by(motion, splats, 0.3)
    assert not torch.equal(coarse.means, splats.means)
    for name in ("quats", "log_scales", "logit_opacities", "sh"):
        assert torch.equal(coarse.tensors()[name], splats.tensors()[name]), name
    motion.advance(0.3)
    fine = moved_by(motion, splats, 0.3)
    for name in ("means", "quats", "log_scales"):
        assert not torch.equal(fine.tensors()[name], coarse.tensors()[name]), name


NO_PLANE_TERMS = {"space_smoothness": 0.0, "time_smoothness": 0.0, "time_stillness": 0.0}


def test_multiscale_regularises_the_coarse_offset() -> None:
    """L_reg is the mean squared offset in units of the bound."""
    splats = splats_of(COUNT)
    motion = disturbed(started("multiscale", offset_weight=2.0, coarse_until=1.0, **NO_PLANE_TERMS))
    motion.advance(0.0)
    offset = moved_by(motion, splats, 0.6).means - splats.means
    penalty = penalty_of(motion, splats, 0.6, generator())
    assert penalty is not None
    expected = 2.0 * (offset / FACTS.bound).square().sum(dim=1).mean()
    torch.testing.assert_close(penalty, expected, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("fine", [False, True])
def test_multiscale_keeps_the_splats_own_features_small(fine: bool) -> None:
    """By the mean square of all of them, once there is something that reads them."""
    weights = {"offset_weight": 0.0, "embedding_weight": 3.0, **NO_PLANE_TERMS}
    motion = disturbed(started("multiscale", **weights))
    motion.advance(1.0 if fine else 0.0)
    penalty = penalty_of(motion, splats_of(COUNT), 0.6, generator())
    assert penalty is not None
    expected = 3.0 * motion.tensors()["embeddings"].square().mean() if fine else torch.zeros(())
    assert not fine or expected > 0
    torch.testing.assert_close(penalty, expected)


def exact(tensors: Mapping[str, Tensor], name: str) -> list[Tensor]:
    """Return the tensors of a grid or a network in float64."""
    return [t.detach().double() for what, t in tensors.items() if what.startswith(f"{name}.")]


def grid_of(tensors: Mapping[str, Tensor], name: str) -> list[Level]:
    parts = exact(tensors, name)
    return [Level(*pair) for pair in zip(parts[::2], parts[1::2], strict=True)]


def features_of(tensors: Mapping[str, Tensor], name: str, means: Tensor, time: float) -> Tensor:
    return lookup_twin(grid_of(tensors, name), means.double(), 2 * time - 1, FACTS.box)


def decoded(x: Tensor, parts: list[Tensor]) -> Tensor:
    """A network with a ReLU after every layer but the last one."""
    for i, (weight, bias) in enumerate(zip(parts[::2], parts[1::2], strict=True)):
        x = (x.relu() if i else x) @ weight + bias
    return x


@pytest.mark.parametrize("pyramid", [True, False])
def test_multiscale_is_its_formula(pyramid: bool) -> None:
    """x + both offsets, q and log s + the fine one; the decoder reads coarse features or not."""
    splats, time = splats_of(COUNT), 0.3
    motion = disturbed(started("multiscale", COUNT, pyramid=pyramid, coarse_channels=32))
    tensors = motion.tensors()
    coarse, fine = (features_of(tensors, name, splats.means, time) for name in ("coarse", "fine"))
    own = tensors["embeddings"].detach().double()
    given = torch.cat([coarse, fine, own] if pyramid else [fine, own], dim=1)
    offset, turn, growth = decoded(given, exact(tensors, "decoder")).split([3, 4, 3], dim=1)
    offset = offset + decoded(coarse, exact(tensors, "coarse_decoder"))
    found = moved_by(motion, splats, time)
    for name, change in (("means", offset), ("quats", turn), ("log_scales", growth)):
        moved = found.tensors()[name].double() - splats.tensors()[name]
        torch.testing.assert_close(moved, change, rtol=1e-4, atol=1e-5, msg=name)
        assert change.abs().max() > 0.01


def test_hexplane_has_heads_that_do_not_read_one_another() -> None:
    """As three networks, each with a hidden layer of its own after the one that they share."""
    splats, width = splats_of(COUNT), 32
    motion = disturbed(started("hexplane", heads="separate", width=width, levels=[8], channels=16))
    tensors = motion.tensors()
    first, bias, second, second_bias, last, last_bias = exact(tensors, "network")
    x = (features_of(tensors, "grid", splats.means, 0.3) @ first + bias).relu()
    found, begin = moved_by(motion, splats, 0.3), 0
    for head, (name, size) in enumerate((("means", 3), ("quats", 4), ("log_scales", 3))):
        own, to = slice(width * head, width * (head + 1)), slice(begin, begin + size)
        change = (x @ second[:, own] + second_bias[own]).relu() @ last[own, to] + last_bias[to]
        moved = found.tensors()[name].double() - splats.tensors()[name]
        torch.testing.assert_close(moved, change, rtol=1e-4, atol=1e-5, msg=name)
        begin += size


@pytest.mark.parametrize("fine", [False, True])
def test_multiscale_regularises_the_grids_that_are_active(fine: bool) -> None:
    weights = {"space_smoothness": 0.3, "time_smoothness": 0.7, "time_stillness": 0.2}
    motion = disturbed(started("multiscale", offset_weight=0.0, coarse_until=0.5, **weights))
    motion.advance(1.0 if fine else 0.0)
    tensors = motion.tensors()
    levels = grid_of(tensors, "coarse") + (grid_of(tensors, "fine") if fine else [])
    expected = penalty_twin(levels, *weights.values())
    found = penalty_of(motion, splats_of(COUNT), 0.6, generator())
    assert found is not None
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("reach", [{"smooth_reach": 0.03}, {}], ids=["given", "by default"])
def test_multiscale_smooths_the_decoder_over_a_reach_in_units_of_the_bound(
    reach: dict[str, float],
) -> None:
    """The mean squared difference of all outputs at a splat and beside it, in float64."""
    splats, time = splats_of(COUNT), 0.6
    weights = {"offset_weight": 0.0, "smooth_weight": 5.0, **NO_PLANE_TERMS}
    motion = disturbed(started("multiscale", COUNT, **weights, **reach))
    found = penalty_of(motion, splats, time, generator(7))
    source, tensors = generator(7), motion.tensors()
    rows = torch.randint(COUNT, (ROWS,), generator=source)
    places = splats.means[rows]
    far = reach.get("smooth_reach", 0.005) * FACTS.bound
    beside = places + far * torch.randn(places.shape, generator=source)
    outputs = [
        decoded(
            torch.cat(
                [
                    features_of(tensors, "coarse", at, time),
                    features_of(tensors, "fine", at, time),
                    tensors["embeddings"].detach().double()[rows],
                ],
                dim=1,
            ),
            exact(tensors, "decoder"),
        )
        for at in (places, beside)
    ]
    expected = 5.0 * (outputs[0] - outputs[1]).square().sum(dim=1).mean()
    assert found is not None
    torch.testing.assert_close(found.double(), expected, rtol=3e-3, atol=0)


def test_multiscale_as_in_the_method_holds_nothing_per_splat() -> None:
    motion = disturbed(started("multiscale", COUNT, embedding=0))
    assert "embeddings" not in {*motion.tensors(), *(p.rate for p in motion.parameters())}
    assert not any(parameter.per_splat for parameter in motion.parameters())
    splats, rows = splats_of(COUNT), torch.tensor([0, 2])
    expected = moved_by(motion, splats, 0.3).take(rows)
    taken(motion, rows)
    assert_equal(moved_by(motion, splats.take(rows), 0.3), expected, atol=1e-6, rtol=1e-6)


def hash_grids_of(tensors: Mapping[str, Tensor], places: Tensor, time: float) -> Tensor:
    """Return the gated features of the defaults' grids, in float64, of places in the cube."""
    space = hash_grid.new_levels([16] * 3, [256] * 3, 8, 15)
    planes_and_time = hash_grid.new_levels([8, 8, 8], [32, 32, 16], 8, 15)
    static = lookup_hashed_twin(space, tensors["space"].detach().double(), places)
    when = places.new_full((len(places), 1), 0.9 * (2 * time - 1))
    x, y, z = places.split(1, dim=1)
    temporal = [
        lookup_hashed_twin(
            planes_and_time, tensors[f"time.{i}"].detach().double(), torch.cat([*axes, when], dim=1)
        )
        for i, axes in enumerate(((x, y), (x, z), (y, z)))
    ]
    score = 2 * decoded(static, exact(tensors, "gate")).sigmoid() - 1
    return score * decoded(torch.cat(temporal, dim=1), exact(tensors, "encoder")).relu()


def in_cube(means: Tensor) -> Tensor:
    """Return where means are in the box of ``FACTS``, from -1 to 1, in float64."""
    lower, upper = (means.new_tensor(corner).double() for corner in FACTS.box)
    return 2 * (means.double() - lower) / (upper - lower) - 1


@pytest.mark.parametrize("time", [0.0, 0.3, 1.0])
def test_hash_grids_are_their_formula(time: float) -> None:
    """Offsets decoded from (2 s(xyz) - 1) relu(g(xyt, xzt, yzt)), of t over 0.9 of the grids."""
    splats, motion = splats_of(COUNT), disturbed(started("hash_grids"))
    gated = hash_grids_of(motion.tensors(), in_cube(splats.means), time)
    parts = decoded(gated, exact(motion.tensors(), "decoder")).split([3, 4, 3], dim=1)
    found = moved_by(motion, splats, time)
    for name, change in zip(("means", "quats", "log_scales"), parts, strict=True):
        moved = found.tensors()[name].double() - splats.tensors()[name]
        torch.testing.assert_close(moved, change, rtol=1e-3, atol=1e-4, msg=name)
        assert change.abs().max() > 0.01


def test_hash_grids_are_smooth_in_space_and_time() -> None:
    """The mean squared difference of gated features at a share of the splats and beside them."""
    options = {"smoothness": 3.0, "share": 0.5, "reach": 0.03, "time_reach": 0.02}
    splats, motion = splats_of(COUNT), disturbed(started("hash_grids", COUNT, **options))
    found = penalty_of(motion, splats, 0.6, generator(7))
    source = generator(7)
    means = splats.means[torch.randint(COUNT, (4,), generator=source)]
    offsets = 2 * torch.rand(4, 4, generator=source) - 1
    beside = means + 0.03 * FACTS.bound * offsets[:, :3]
    squares = []
    for mean, other, offset in zip(means, beside, offsets.double(), strict=True):
        here = hash_grids_of(motion.tensors(), in_cube(mean[None]), 0.6)
        there = hash_grids_of(motion.tensors(), in_cube(other[None]), 0.6 + 0.02 * float(offset[3]))
        squares.append((here - there).square().mean())
    assert found is not None
    torch.testing.assert_close(found.double(), 3 * torch.stack(squares).mean(), rtol=5e-3, atol=0)
    off = disturbed(started("hash_grids", COUNT, smoothness=0.0))
    assert penalty_of(off, splats, 0.6, generator(7)) is None


def test_hash_grids_give_positions_no_gradient() -> None:
    splats = splats_of(COUNT).map(torch.nn.Parameter)
    moved_by(disturbed(started("hash_grids")), splats, 0.3).means.sum().backward()
    assert torch.equal(splats.means.grad, torch.ones_like(splats.means))


def trained_within(value: object) -> list[Tensor]:
    """Return all trained leaves that an object holds, also those in lists and tuples."""
    if isinstance(value, Tensor):
        return [value] if value.requires_grad else []
    if isinstance(value, list | tuple):
        return [tensor for item in value for tensor in trained_within(item)]
    return []


def trained_of(motion: Layer) -> list[Tensor]:
    """Return the tensors that have a learning rate; buffers have none."""
    return [p.tensor for p in motion.parameters() if p.rate is not None]


@pytest.mark.parametrize(
    ("name", "options"),
    [*((name, {}) for name in plugins.names(motions.__name__)), ("multiscale", {"embedding": 0})],
)
def test_all_that_is_trained_goes_where_the_model_goes(name: str, options: dict[str, int]) -> None:
    """What a motion reads are the very tensors that its parameters name, and none is empty."""
    motion = started(name, COUNT, **options)
    held = trained_within(list(vars(motion).values()))
    assert {*map(id, held)} == {*map(id, trained_of(motion))}
    assert all(tensor.numel() for tensor in held)
    model_of(splats_of(COUNT), motion).to("cpu")
    assert {*map(id, held)} == {*map(id, trained_of(motion))}


@pytest.mark.parametrize(
    ("name", "option", "value", "allowed"),
    [
        *(("hexplane", *wrong) for wrong in WRONG),
        *(("control_points", *wrong) for wrong in WRONG),
        *(("multiscale", key, value, allowed.replace("8", "7")) for key, value, allowed in WRONG),
        ("multiscale", "levels", [16] * 8, "1 to 7 whole numbers, each 2 or more"),
        ("multiscale", "coarse_level", 1, "2 or more"),
        ("multiscale", "coarse_channels", 24, "a multiple of 16, 16 or more"),
        ("multiscale", "embedding", -16, "a multiple of 16, 0 or more"),
        ("multiscale", "embedding", 8, "a multiple of 16, 0 or more"),
        ("hash_grids", "space_levels", 0, "1 to 32"),
        ("hash_grids", "time_levels", 48, "1 to 32"),
        ("hash_grids", "time_levels", 9, "times features a multiple of 16"),
        ("hash_grids", "features", 9, "1 to 8"),
        ("hash_grids", "space_resolutions", [1, 16], r"\[first, last\], the first 2 or more"),
        ("hash_grids", "time_resolutions", [8, 4], r"\[first, last\], the first 2 or more"),
        ("hash_grids", "log2_rows", 25, "4 to 24"),
        ("hash_grids", "rate", [0, 1], r"\[start, end\], both above 0"),
        ("hash_grids", "reach", -1, "0 or more"),
        ("hash_grids", "share", 0, "above 0, at most 1"),
    ],
)
def test_sizes_that_no_kernel_serves_are_refused(
    name: str, option: str, value: object, allowed: str
) -> None:
    with pytest.raises(UsageError, match=f"motion: {option} is .*; allowed: {allowed}$"):
        options_of(motions.__name__, {"name": name, option: value})


@pytest.mark.parametrize(
    ("name", "most"), [("hexplane", 8), ("control_points", 8), ("multiscale", 7)]
)
def test_as_many_levels_as_kernels_serve_are_taken(name: str, most: int) -> None:
    motion = started(name, COUNT, levels=[2] * most)
    moved = moved_by(motion, splats_of(COUNT), 0.4)
    assert_equal(moved, splats_of(COUNT), atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize(("frames", "resolution"), [(2, 8), (100, 25), (150, 38)])
def test_the_time_grid_follows_from_the_frames(frames: int, resolution: int) -> None:
    motion = start_motion({"name": "hexplane"}, Facts(1.0, CUBE, frames), 1)
    assert motion.tensors()["grid.0.time"].shape[2] == resolution


def control_points_of(splats: int, **options: float) -> Layer:
    return start_motion({"name": "control_points", **options}, FACTS, splats)


def test_control_points_are_anchored_to_splats_that_show_and_all_goes_on_nearly_as_before() -> None:
    splats = splats_of(3000)
    splats.logit_opacities[:1000] = -9.0
    splats.means[:1000] += 5.0
    motion = disturbed(control_points_of(3000, count=600))
    before = moved_by(motion, splats, 0.4)
    with torch.no_grad():
        assert set(motion.reanchor(splats)) == {"control_points", "log_radii"}
    assert are_among(motion.tensors()["control_points"], splats.means[1000:])
    after = moved_by(motion, splats, 0.4)
    moved = (after.means - splats.means)[1000:].norm(dim=1).mean()
    jumped = (after.means - before.means)[1000:].norm(dim=1).mean()
    assert float(jumped.detach()) < 0.2 * float(moved.detach())


@torch.no_grad()
def test_a_motion_that_is_the_same_everywhere_stays_what_it_was_when_anchored_anew() -> None:
    splats, motion = splats_of(300), control_points_of(300, count=30)
    tensors = motion.tensors()
    names = [name for name in tensors if name.startswith("network.")]
    for name in names:
        tensors[name].zero_()
    tensors[names[-1]][:3] = torch.tensor([0.1, -0.2, 0.3])
    for _ in range(2):
        moved = moved_by(motion, splats, 0.4)
        way = torch.tensor([0.1, -0.2, 0.3]).expand(300, 3)
        torch.testing.assert_close(moved.means - splats.means, way, rtol=0, atol=1e-6)
        splats.means.mul_(0.5)
        motion.reanchor(splats)
        assert are_among(tensors["control_points"], splats.means)


def spacing_of(points: Tensor) -> Tensor:
    """Root mean square of the distances to the three nearest others, in float64."""
    squares = torch.cdist(points.double(), points.double()).square()
    return squares.fill_diagonal_(torch.inf).sort(dim=1).values[:, :3].mean(dim=1).sqrt()


@torch.no_grad()
def test_radii_of_control_points_are_how_far_apart_they_are() -> None:
    """At the start and wherever they are anchored; never below a thousandth of the bound."""
    motion = control_points_of(300, count=30)
    points, log_radii = (motion.tensors()[name] for name in ("control_points", "log_radii"))
    torch.testing.assert_close(log_radii.exp(), spacing_of(points).float())
    splats = splats_of(300)
    splats.means.mul_(0.1)
    motion.reanchor(splats)
    torch.testing.assert_close(log_radii.exp(), spacing_of(points).float())
    assert log_radii.exp().max() < 0.2
    splats.means.fill_(0.5)
    motion.reanchor(splats)
    torch.testing.assert_close(log_radii.exp(), torch.full((30,), 1e-3 * FACTS.bound))


class HalfMoves(ControlPoints):
    """Control points of which those of x below 0 go far, 50 times by what the others go."""

    def _deformations(self, points: Tensor, times: Sequence[float]) -> Tensor:
        way = torch.where(points[:, 0] < 0, 0.5, 0.01)
        found = torch.zeros(len(times), len(points), OUTPUTS)
        found[..., 0] = torch.tensor(times)[:, None] * way
        return found


@pytest.mark.parametrize(("gather", "least", "most"), [(1.0, 0.9, 1.1), (2.0, 1.5, 2.2)])
@torch.no_grad()
def test_control_points_lie_nearer_to_each_other_where_splats_move(
    gather: float, least: float, most: float
) -> None:
    splats = splats_of(6000)
    splats.logit_opacities.fill_(1.0)
    splats.means[:, 2] = 0.0
    motion = HalfMoves(300, 4, gather, FACTS, generator())
    motion.reanchor(splats)
    points, log_radii = (motion.tensors()[name] for name in ("control_points", "log_radii"))
    assert are_among(points, splats.means)
    goes = points[:, 0] < 0
    denser = (log_radii[~goes].mean() - log_radii[goes].mean()).exp()
    assert least < float(denser) < most
    assert (int(goes.sum()) > 200) == (gather > 1)


@torch.no_grad()
def test_control_points_lie_evenly_where_nothing_moves_yet() -> None:
    splats = splats_of(2000)
    placed = []
    for gather in (1.0, 4.0):
        motion = control_points_of(2000, count=100, gather=gather)
        motion.reanchor(splats)
        placed.append(motion.tensors()["control_points"].clone())
    assert torch.equal(*placed)


def test_control_points_are_anchored_where_splats_are_if_too_few_of_them_show() -> None:
    splats, motion = splats_of(20), control_points_of(20, count=30)
    splats.logit_opacities.fill_(-9.0)
    with torch.no_grad():
        motion.reanchor(splats)
    assert are_among(motion.tensors()["control_points"], splats.means)


def test_control_points_are_anchored_to_finite_splats() -> None:
    splats, motion = splats_of(50), control_points_of(50, count=30)
    splats.means[::2, 1] = float("nan")
    with torch.no_grad():
        motion.reanchor(splats)
        assert are_among(motion.tensors()["control_points"], splats.means[1::2])
        splats.means[1::2, 0] = float("inf")
        assert motion.reanchor(splats) == ()
    assert are_among(motion.tensors()["control_points"], splats_of(50).means)


@torch.no_grad()
def test_control_points_follow_splats_that_have_changed_since() -> None:
    """What is kept of one drawing for the next must not outlive the splats it was found for."""
    splats, motion = splats_of(COUNT), disturbed(started("control_points"))
    moved_by(motion, splats, 0.3)
    others = splats_of(COUNT, seed=1)
    expected = moved_by(disturbed(started("control_points")), others, 0.3)
    assert_equal(moved_by(motion, others, 0.3), expected)
    splats.means.copy_(others.means)
    motion.advance(1.0)
    assert torch.equal(moved_by(motion, splats, 0.3).means, expected.means)


@torch.no_grad()
def test_control_points_follow_splats_that_have_changed_in_place() -> None:
    """As an optimiser changes them: at the same address, of the same number."""
    splats, motion = splats_of(COUNT), disturbed(started("control_points"))
    moved_by(motion, splats, 0.3)
    splats.means.neg_()
    motion.advance(1.0)
    expected = moved_by(disturbed(started("control_points")), splats, 0.3)
    assert_equal(moved_by(motion, splats, 0.3), expected)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"count": 3}, "count is 3; allowed: 4 or more"),
        ({"neighbours": 2000}, "1 to count"),
        ({"gather": 0.5}, "gather is 0.5; allowed: 1 or more"),
        ({"time_ends": 0.0}, "time_ends is 0.0; allowed: above 0, at most 1"),
        ({"time_ends": 1.5}, "time_ends is 1.5; allowed: above 0, at most 1"),
        ({"time_degree": 2}, "time_degree is 2; allowed: 1 or 3"),
        ({"rigidity_until": 1.5}, "rigidity_until is 1.5; allowed: a progress from 0 to 1"),
    ],
)
def test_control_points_refuse_numbers_out_of_range(options: dict[str, float], found: str) -> None:
    with pytest.raises(UsageError, match=found):
        control_points_of(1, **options)


def test_the_rigidity_of_control_points_has_its_weight() -> None:
    """What the mean over pairs is of |A_i (p_j - p_i) + p_i + t_i - (p_j + t_j)|^2 / |p_j - p_i|^2.

    In float64, of each point and the nearest four, itself among them.
    """
    options = {"count": 20, "neighbours": 4, "rigidity": 3.0, **NO_PLANE_TERMS}
    motion = disturbed(started("control_points", **options))
    found = penalty_of(motion, splats_of(COUNT), 0.6, generator(5))
    time, tensors = float(torch.rand((), generator=generator(5))), motion.tensors()
    points = tensors["control_points"].detach().double()
    features = features_of(tensors, "grid", points, time)
    offset, turn, _ = decoded(features, exact(tensors, "network")).split([3, 4, 3], dim=1)
    w, x, y, z = normalize(turn + turn.new_tensor([1.0, 0.0, 0.0, 0.0]), dim=1).unbind(1)
    rotations = torch.from_numpy(
        Rotation.from_quat(torch.stack([x, y, z, w], dim=1).numpy()).as_matrix()
    )
    near = torch.cdist(points, points).argsort(dim=1)[:, :4]
    shares = []
    for i in range(20):
        for j in near[i].tolist():
            apart = points[j] - points[i]
            off = rotations[i] @ apart + points[i] + offset[i] - points[j] - offset[j]
            shares.append(float(off.square().sum() / apart.square().sum()) if i != j else 0.0)
    assert found is not None
    assert found.item() == pytest.approx(3.0 * sum(shares) / len(shares), rel=1e-3)


def test_control_points_are_to_move_as_parts_of_a_rigid_body() -> None:
    """At any moment: of two penalties that differ in their random numbers alone, one is larger."""
    motion = disturbed(started("control_points", rigidity=2.0, **NO_PLANE_TERMS))
    first, second = (penalty_of(motion, splats_of(COUNT), 0.6, generator(seed)) for seed in (1, 2))
    assert first is not None and second is not None and first > 0 and first != second
    assert first == penalty_of(motion, splats_of(COUNT), 0.1, generator(1))
    names = list(motion.tensors())
    gradients = torch.autograd.grad(first, list(motion.tensors().values()), allow_unused=True)
    learnt = {name for name, part in zip(names, gradients, strict=True) if part is not None}
    assert {name for name in names if name.startswith(("grid", "network"))} <= learnt
    assert "control_points" not in learnt
    loose = disturbed(started("control_points", rigidity=0.0, **NO_PLANE_TERMS))
    assert not penalty_of(loose, splats_of(COUNT), 0.6, generator())


def test_control_points_may_have_fewer_nodes_at_both_ends() -> None:
    """Half as dense at the ends: u = 2 t - 1 is read at (u - 0.2 u^3) / 0.8 (float64)."""
    even, uneven = (
        disturbed(started("control_points", COUNT, time_ends=ends)) for ends in (1.0, 0.5)
    )
    splats = splats_of(COUNT)
    for time in (0.0, 0.1, 0.5, 0.8, 1.0):
        u = 2 * time - 1
        place = ((u - 0.2 * u**3) / 0.8 + 1) / 2
        expected = moved_by(even, splats, place)
        assert_equal(moved_by(uneven, splats, time), expected, rtol=1e-4, atol=1e-5)
    before = [moved_by(uneven, splats, time) for time in (0.4, 0.5, 0.6)]
    model_of(splats, uneven).hold_outside(0.4, 0.6)
    for time, expected in zip((0.4, 0.5, 0.6), before, strict=True):
        assert_equal(moved_by(uneven, splats, time), expected, rtol=1e-5, atol=1e-6)
    still = [moved_by(uneven, splats, time) for time in (0.8, 1.0)]
    assert_equal(*still, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "grid"),
    [("control_points", "grid.0"), ("hexplane", "grid.0"), ("multiscale", "fine.0")],
)
def test_grids_may_have_cubic_curves_in_time(name: str, grid: str) -> None:
    """Velocity jumps at a node of the grid only where lines lie between nodes."""
    splats, jumps = splats_of(COUNT), []
    for degree in (1, 3):
        motion = disturbed(started(name, COUNT, time_degree=degree))
        motion.advance(1.0)
        nodes = motion.tensors()[f"{grid}.time"].shape[2]
        node, step = 3 / (nodes - 1), 1e-2 / (nodes - 1)
        before, at, after = (
            moved_by(motion, splats, node + shift).means.detach() for shift in (-step, 0.0, step)
        )
        jumps.append(float((after - 2 * at + before).norm() / (after - before).norm()))
    linear, cubic = jumps
    assert cubic < 0.1 * linear
    shown = [moved_by(motion, splats, time) for time in (0.4, 0.5, 0.6)]
    model_of(splats, motion).hold_outside(0.4, 0.6)
    for time, expected in zip((0.4, 0.5, 0.6), shown, strict=True):
        assert_equal(moved_by(motion, splats, time), expected, rtol=1e-5, atol=1e-6)


def test_control_points_may_move_freely_in_the_end() -> None:
    """The weight of rigidity falls from half of ``rigidity_until`` on; by itself it stays."""

    def penalties(**options: float) -> list[float]:
        motion = disturbed(started("control_points", rigidity=2.0, **options, **NO_PLANE_TERMS))
        values = []
        for progress in (0.0, 0.2, 0.3, 0.375, 0.6, 1.0, 0.3):  # a resumed training may go back
            motion.advance(progress)
            value = penalty_of(motion, splats_of(COUNT), 0.6, generator(1))
            values.append(0.0 if value is None else value.item())
        return values

    full = penalties()[0]
    assert penalties() == [full] * 7
    shares = (1.0, 1.0, 1.0, 0.75, 0.0, 0.0, 1.0)
    assert penalties(rigidity_until=0.6) == pytest.approx([full * share for share in shares])
