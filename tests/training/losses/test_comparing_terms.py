"""Terms that compare two times: closed forms, gradients, choices by chance, and trainings."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from kernel_checks import assert_near, generator
from scipy.spatial.transform import Rotation
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.training.losses import Seen, start_term
from gsdmsr_cli.training.losses._comparing import adjacent_time, any_time, first_time

NEIGHBOURS = ("arap", "isometry", "rigidity", "rotation_similarity")
RIGID = (*NEIGHBOURS, "rigid_velocity")
EVERY = (*RIGID, "temporal_smoothness")

TETRAHEDRON = [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]
"""All distances are the root of 2; of the edges two thirds go one up or down."""


def splats_at(means: Tensor, quats: Tensor | None = None) -> Splats:
    """Return splats at places (N, 3), in float64, with rotations or without."""
    means = means.double()
    nothing = means.new_zeros(len(means), 3)
    if quats is None:
        quats = means.new_tensor([[1.0, 0.0, 0.0, 0.0]]).expand(len(means), 4)
    return Splats(means, quats.double(), nothing - 3, nothing[:, 0], nothing[:, None])


def some_splats(count: int, seed: int = 0) -> Splats:
    rng = generator(seed)
    return splats_at(torch.rand(count, 3, generator=rng), torch.randn(count, 4, generator=rng))


def turned_by(splats: Splats, turn: Rotation, shift: list[float]) -> Splats:
    """Return the splats after a rigid movement, each quaternion perhaps the negative one."""
    means = turn.apply(splats.means.numpy()) + shift
    own = Rotation.from_quat(splats.quats.numpy(), scalar_first=True)
    quats = torch.from_numpy((turn * own).as_quat(scalar_first=True))
    signs = 2 * torch.randint(0, 2, (len(splats), 1), generator=generator(3)) - 1
    return replace(splats, means=torch.from_numpy(means), quats=2 * signs * quats)


def seen_of(now: Splats, other: Splats | None, seed: int = 7, **moment: Any) -> Seen:
    """Return what a term is given of times 0.5 and 0.25; nothing of it is a picture."""
    pictureless: Any = None
    given = [pictureless] * 4
    then = None if other is None else Moment(other)
    return Seen(*given, Instant(0.5), Moment(now, **moment), Instant(0.25), then, seed=seed)


def value(name: str, now: Splats, other: Splats, **options: Any) -> float:
    return float(start_term({"name": name, **options})(seen_of(now, other)))


@pytest.mark.parametrize("name", RIGID)
def test_a_rigid_movement_costs_nothing(name: str) -> None:
    before = some_splats(40)
    after = turned_by(before, Rotation.from_rotvec([0.9, -1.1, 2.0]), [0.3, -2.0, 1.0])
    assert value(name, after, before) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("name", "movement", "expected"),
    [
        ("rigidity", torch.diag(torch.tensor([1.1, 1.1, 1.1])), 0.1),
        ("rigidity", torch.tensor([[1.0, 0, 0.3], [0, 1, 0], [0, 0, 1]]), 0.3 * 2 / 3 / 2**0.5),
        ("isometry", torch.diag(torch.tensor([0.9, 0.9, 0.9])), 0.1),
        ("arap", torch.diag(torch.tensor([0.8, 0.8, 0.8])), 0.04),
        ("rotation_similarity", torch.diag(torch.tensor([1.2, 1.0, 1.0])), 0.0),
        ("rigid_velocity", torch.diag(torch.tensor([1.1, 1.1, 1.1])), (0.1 / 0.25) ** 2 * 0.75),
    ],
)
def test_a_stretch_or_a_shear_of_a_tetrahedron_costs_what_it_is(
    name: str, movement: Tensor, expected: float
) -> None:
    """In units of the edge; of velocities in those of the world and the capture."""
    before = splats_at(torch.tensor(TETRAHEDRON))
    after = replace(before, means=before.means @ movement.double().T)
    options = {"parts": 1} if name == "rigid_velocity" else {"neighbours": 3}
    assert value(name, after, before, **options) == pytest.approx(expected, abs=1e-6)


def test_as_rigid_as_possible_is_what_the_best_rotations_leave() -> None:
    """Of each corner of a stretched tetrahedron and the ways to the others, as SciPy finds them."""
    before = torch.tensor(TETRAHEDRON)
    after = before @ torch.tensor([[1.5, 0.4, 0.0], [0.0, 1.0, 0.0], [0.0, 0.2, 0.9]])
    left = 0.0
    for i in range(4):
        ways = [(x - x[i])[torch.arange(4) != i].numpy() for x in (after, before)]
        left += Rotation.align_vectors(*ways)[1] ** 2
    found = value("arap", splats_at(after), splats_at(before), neighbours=3)
    assert found == pytest.approx(left / 12 / 2, rel=1e-6)


def test_neighbours_that_turn_unlike_each_other_cost_the_chord_between_their_turns() -> None:
    before, angles = splats_at(torch.tensor(TETRAHEDRON)), torch.tensor([0.0, 0.1, 0.3, 0.7])
    quats = torch.zeros(4, 4).double()
    quats[:, 0], quats[:, 3] = (angles / 2).cos(), (angles / 2).sin()
    apart = [abs(float(a - b)) for i, a in enumerate(angles) for b in angles[i + 1 :]]
    expected = sum(2 * math.sin(angle / 4) for angle in apart) / 6
    found = value("rotation_similarity", replace(before, quats=quats), before, neighbours=3)
    assert found == pytest.approx(expected, rel=1e-6)


def test_two_bodies_are_two_rigid_velocity_fields() -> None:
    first, second = some_splats(30, 1), some_splats(20, 2)
    second = replace(second, means=second.means + 5)
    turns = Rotation.from_rotvec([0.0, 0.0, 0.4]), Rotation.from_rotvec([0.3, 0.2, 0.0])
    bodies = [(first, turned_by(first, turns[0], [0.1, 0.0, 0.0])), (second, None)]
    bodies[1] = (second, turned_by(second, turns[1], [0.0, 0.0, 0.3]))
    before, after = (splats_at(torch.cat([b[i].means for b in bodies])) for i in (0, 1))
    together, apart = (value("rigid_velocity", after, before, parts=n) for n in (1, 8))
    assert apart == pytest.approx(0, abs=1e-9) and together > 0.1


def test_smoothness_is_the_mean_squared_rate_of_all_that_moves() -> None:
    before = splats_at(torch.tensor(TETRAHEDRON))
    quats = 3 * torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(4, 4)
    moved = replace(splats_at(before.means + 0.2, quats), log_scales=before.log_scales - 0.3)
    expected = (3 * 0.2**2 + 2 + 3 * 0.3**2) / 0.25**2
    assert value("temporal_smoothness", moved, before) == pytest.approx(expected)


def test_nearer_neighbours_count_more() -> None:
    """The weighted mean over all pairs, in float64: exp(-d^2 / (2 mean d^2)) by the other time."""
    now, other, count, near = some_splats(12, 1), some_splats(12, 2), 12, 4
    distances = torch.cdist(other.means, other.means)
    turns = [
        torch.from_numpy(Rotation.from_quat(s.quats.numpy(), scalar_first=True).as_matrix())
        for s in (now, other)
    ]
    pairs, squares = [], []
    for i in range(count):
        for j in distances[i].argsort()[1 : near + 1].tolist():
            back = turns[1][i] @ turns[0][i].T
            way = back @ (now.means[j] - now.means[i])
            pairs.append((other.means[j] - other.means[i] - way).norm())
            squares.append(distances[i, j] ** 2)
    off, square = torch.stack(pairs), torch.stack(squares)
    weights = torch.exp(-square / (2 * square.mean()))
    expected = (weights * off).sum() / weights.sum() / square.mean().sqrt()
    found = value("rigidity", now, other, neighbours=near)
    assert found == pytest.approx(float(expected), rel=1e-9)


@pytest.mark.parametrize("name", EVERY)
def test_gradients_are_those_of_the_value(name: str) -> None:
    """By finite differences in float64, and in float32 as in float64."""
    now, other = some_splats(9, 1), some_splats(9, 2)
    options = {"neighbours": 3} if name in NEIGHBOURS else {}
    options |= {"parts": 2} if name == "rigid_velocity" else {}
    term = start_term({"name": name, **options})

    def of(means: Tensor, quats: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
        moved = replace(now.map(lambda t: t.to(dtype)), means=means, quats=quats)
        return term(seen_of(moved, other.map(lambda t: t.to(dtype))))

    leaves = [t.clone().requires_grad_() for t in (now.means, now.quats)]
    assert torch.autograd.gradcheck(of, leaves)
    exact = torch.autograd.grad(of(*leaves), leaves, allow_unused=True)
    single = [t.detach().float().requires_grad_() for t in leaves]
    found = torch.autograd.grad(of(*single, torch.float32), single, allow_unused=True)
    for one, two, part in zip(found, exact, ("means", "quats"), strict=True):
        assert (one is None) == (two is None)
        if one is not None:
            assert_near(one, two, 1e-4, part)
    assert any(gradient is not None and gradient.any() for gradient in exact)


def test_the_second_time_learns_as_well() -> None:
    """Of a pair of moments neither is the true one; but where neighbours are is taken as given."""
    now, other = some_splats(9, 1), some_splats(9, 2)
    for name in EVERY:
        leaf = other.map(lambda t: t.clone().requires_grad_())
        start_term({"name": name})(seen_of(now, leaf)).backward()
        asked = leaf.quats if name == "rotation_similarity" else leaf.means
        assert asked.grad is not None and asked.grad.any(), name


@pytest.mark.parametrize("name", RIGID)
def test_which_splats_are_looked_at_follows_from_the_seed(name: str) -> None:
    now, other = some_splats(300, 1), some_splats(300, 2)
    term = start_term({"name": name, "samples": 20})
    values = [float(term(seen_of(now, other, seed))) for seed in (1, 2, 1)]
    assert values[0] == values[2] != values[1]


@pytest.mark.parametrize("name", EVERY)
def test_what_is_not_finite_is_left_out(name: str) -> None:
    now, other = some_splats(20, 1), some_splats(20, 2)
    now.means[3, 1], now.quats[5, 0], other.log_scales[7, 2] = math.nan, math.inf, math.nan
    leaf = now.map(lambda t: t.clone().requires_grad_())
    found = start_term({"name": name})(seen_of(leaf, other))
    assert found.isfinite() and found > 0
    found.backward()
    for gradient in (leaf.means.grad, leaf.quats.grad):
        assert gradient is None or (gradient.isfinite().all() and not gradient[[3, 5, 7]].any())


@pytest.mark.parametrize("name", EVERY)
def test_without_a_second_time_or_a_neighbour_there_is_nothing_to_compare(name: str) -> None:
    term, splats = start_term({"name": name}), some_splats(1)
    assert float(term(seen_of(splats, None))) == 0
    assert float(term(seen_of(splats, splats))) == 0


def test_splats_in_one_place_are_no_neighbourhood() -> None:
    splats = splats_at(torch.zeros(6, 3))
    for name in EVERY:
        assert value(name, splats, splats) == 0, name


@pytest.mark.parametrize("name", ["rigidity", "rotation_similarity"])
def test_splats_drawn_from_axes_have_no_rotations_to_compare(name: str) -> None:
    splats = some_splats(5)
    seen = seen_of(splats, splats, axes=torch.eye(3).double().expand(5, 3, 3))
    with pytest.raises(UsageError, match=f"^the term '{name}' compares rotations, which .*; take"):
        start_term({"name": name})(seen)


def test_second_times_are_train_times_other_than_the_own() -> None:
    times, rng = (0.0, 0.2, 0.5, 1.0), generator()
    beside = {time: {adjacent_time(time, times, rng) for _ in range(30)} for time in times}
    assert beside == {0.0: {0.2}, 0.2: {0.0, 0.5}, 0.5: {0.2, 1.0}, 1.0: {0.5}}
    assert {any_time(0.2, times, rng) for _ in range(50)} == {0.0, 0.5, 1.0}
    assert [first_time(time, times) for time in times] == [None, 0.0, 0.0, 0.0]
    assert adjacent_time(0.3, (0.3,), rng) is any_time(0.3, (0.3,), rng) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "rigidity", "neighbours": 0}, "neighbours is 0; allowed: 1 or more"),
        ({"name": "arap", "samples": 0}, "samples is 0; allowed: 1 or more"),
        ({"name": "isometry", "factor": 0}, "factor is 0.0; allowed: a number above 0"),
        ({"name": "temporal_smoothness", "until": 2}, "until is 2.0; allowed: a progress from"),
        ({"name": "rigid_velocity", "parts": 0}, "parts is 0; allowed: 1 or more"),
        ({"name": "rigid_velocity", "part": 3}, "unknown key 'part'; did you mean 'parts'"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        start_term(options)


def test_they_train_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    few = {name: ", samples: 32" for name in RIGID}
    terms = ", ".join(f"{{name: {name}, until: 0.9{few.get(name, '')}}}" for name in EVERY)
    assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, f"losses.terms=[{terms}]")


def test_the_more_arap_counts_the_more_rigidly_neighbours_move(tiny_scene: Path) -> None:
    fast = "optimizer.planes=[0.05,0.01]", "optimizer.network=[0.02,0.002]"
    found = []
    for factor in (1e-9, 10.0):
        terms = f"losses.terms=[{{name: arap, factor: {factor}}}]"
        trainer = trainer_of(tiny_scene, preset_of(terms, *fast))
        for _ in range(STEPS):
            trainer.step()
        model = trainer.model
        ends = (model.at(model.instant(time)).splats.detach() for time in (1.0, 0.0))
        found.append(value("arap", *ends))
    assert 0 < found[1] < 0.5 * found[0]
