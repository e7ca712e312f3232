"""Cells: how splats are sorted into them, and that a splat does what all of its cells do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from motion_checks import FACTS, moved_by, splats_of
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import options_of
from gsdmsr_cli.model.motion._halving import cells_of
from gsdmsr_cli.model.motion.cells import Cells, Options

COUNT = 40


def settled(splats: Splats, most: tuple[int, ...] = (20, 5)) -> Cells:
    """Cells as they are at the second moment of two, at which nothing has moved yet."""
    cells = Cells(Options(splats=most), FACTS, len(splats))
    cells.settle(splats, first=True)
    cells.go_on(0.0, 0.0, 1.0, 1.0)
    return cells


def wxyz(rotation: Rotation) -> Tensor:
    return torch.from_numpy(np.roll(rotation.as_quat(), 1)).float()


@given(
    st.integers(1, 90),
    st.lists(st.integers(1, 50), min_size=1, max_size=3, unique=True),
    st.booleans(),
)
def test_cells_are_nested_and_none_has_too_many_points(
    count: int, most: list[int], same: bool
) -> None:
    most = sorted(most, reverse=True)
    points = np.random.default_rng(count).normal(size=(count, 3)) * (not same)
    found = cells_of(points, most)
    assert found.shape == (count, len(most)) and found.dtype == np.int32
    assert np.array_equal(np.unique(found), np.arange(found.max() + 1))
    for level, limit in enumerate(most):
        names, sizes = np.unique(found[:, level], return_counts=True)
        assert sizes.max() <= limit
        if level:
            assert names.min() == found[:, level - 1].max() + 1
            for name in names:
                assert len(np.unique(found[found[:, level] == name, level - 1])) == 1


def test_cells_lie_apart_along_their_longest_side() -> None:
    points = np.zeros((16, 3))
    points[:, 1] = np.random.default_rng(0).permutation(16)
    found = cells_of(points, [4])[:, 0]
    assert np.array_equal(found, points[:, 1] // 4)


def test_new_cells_leave_splats_where_they_are() -> None:
    splats = splats_of(COUNT)
    for time in (0.0, 0.5, 1.0):
        moved = moved_by(settled(splats), splats, time)
        torch.testing.assert_close(moved.means, splats.means)
        torch.testing.assert_close(moved.quats, splats.quats)


def test_the_splats_of_a_cell_turn_about_their_mean_and_others_stay() -> None:
    splats, turn = splats_of(COUNT), Rotation.from_rotvec([0.3, -0.9, 0.4])
    motion = settled(splats)
    one = int(motion.cells[7])
    motion.turns.data[one] = wxyz(turn) - torch.tensor([1.0, 0, 0, 0])
    motion.offsets.data[one] = torch.tensor([0.1, 0.0, -0.2])
    moved, inside = moved_by(motion, splats, 1.0), motion.cells == one
    assert 1 < inside.sum() < COUNT
    torch.testing.assert_close(moved.means[~inside], splats.means[~inside])
    middle = splats.means[inside].mean(dim=0)
    arms = (splats.means[inside] - middle).numpy()
    shift = FACTS.bound * np.array([0.1, 0.0, -0.2])
    expected = torch.from_numpy(turn.apply(arms) + middle.numpy() + shift).float()
    torch.testing.assert_close(moved.means[inside], expected, rtol=0, atol=1e-5)
    own = Rotation.from_quat(np.roll(splats.quats.numpy(), -1, axis=1))
    both = Rotation.from_quat(np.roll(moved.quats.detach().numpy(), -1, axis=1))
    wanted = [turn * q if i else q for q, i in zip(own, inside.tolist(), strict=True)]
    apart = [(a.inv() * b).magnitude() for a, b in zip(wanted, both, strict=True)]
    assert max(apart) < 1e-5


def test_a_splat_goes_with_the_cells_of_all_levels() -> None:
    splats = splats_of(COUNT)
    motion = settled(splats)
    offsets = 0.1 * torch.randn(len(motion.offsets), 3)
    motion.offsets.data.copy_(offsets)
    moved = moved_by(motion, splats, 1.0)
    levels = cells_of(splats.means.numpy(), (20, 5))
    expected = splats.means + FACTS.bound * offsets[torch.from_numpy(levels).long()].sum(dim=1)
    torch.testing.assert_close(moved.means, expected, rtol=0, atol=1e-6)


def test_gradients_are_those_of_differences() -> None:
    splats = splats_of(COUNT).map(torch.Tensor.double)
    motion = settled(splats_of(COUNT))
    for parameter in motion.parameters():
        if parameter.tensor.dtype == torch.float32:
            parameter.set_values(parameter.tensor.double())
    count = len(motion.offsets)

    def moved(offsets: Tensor, turns: Tensor) -> Any:
        motion.offsets, motion.turns = offsets, turns
        return tuple(motion.of_splats(splats.means, 2))

    rng = torch.Generator().manual_seed(0)
    given = [0.2 * torch.randn(count, k, generator=rng, dtype=torch.float64) for k in (3, 4)]
    assert torch.autograd.gradcheck(moved, [tensor.requires_grad_() for tensor in given])


def test_cells_of_another_number_are_restored_and_move_the_same() -> None:
    splats = splats_of(COUNT)
    motion = settled(splats)
    motion.offsets.data.normal_()
    again = Cells(Options(splats=(20, 5)), FACTS, COUNT)
    again.restore(motion.tensors(), COUNT)
    found, expected = (moved_by(own, splats, 0.7) for own in (again, motion))
    assert torch.equal(found.means, expected.means)


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("cells", torch.full((COUNT,), 99, dtype=torch.int32), "not among the"),
        ("around", torch.tensor([0, 0], dtype=torch.int32), "2 and 10 of 10 cells"),
        ("offsets", torch.zeros(3, 3), "of 3 and of"),
    ],
)
def test_what_does_not_fit_together_is_refused(name: str, wrong: Tensor, message: str) -> None:
    tensors = settled(splats_of(COUNT)).tensors() | {name: wrong}
    with pytest.raises(ValueError, match=message):
        Cells(Options(splats=(20, 5)), FACTS, COUNT).restore(tensors, COUNT)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"splats": []}, "one number or more"),
        ({"splats": [8, 64]}, "which descend"),
        ({"splats": [8, 0]}, "1 or more each"),
        ({"rate": [0.0, 1e-4]}, "both above 0"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        options_of("gsdmsr_cli.model.motion", {"name": "cells", **options})


def test_levels_learn_from_their_time_on_the_largest_first() -> None:
    splats = splats_of(COUNT)
    cells = Cells(Options(splats=(20, 10, 5), join=(0.0, 0.25, 0.5)), FACTS, COUNT)
    cells.settle(splats, first=True)
    cells.go_on(0.0, 0.0, 1.0, 1.0)
    levels = cells_of(splats.means.detach().numpy() / FACTS.bound, (20, 10, 5))
    first = torch.tensor([levels[:, level].max() for level in range(3)]) + 1
    for progress, joined in ((0.0, 1), (0.3, 2), (0.5, 3), (0.9, 3)):
        cells.advance(progress)
        (moved_by(cells, splats, 1.0).means ** 2).sum().backward()
        with_gradient = cells.offsets.grad.abs().sum(dim=1) > 0
        assert with_gradient.sum() == first[joined - 1] and with_gradient[: first[joined - 1]].all()
        cells.offsets.grad = None


@pytest.mark.parametrize("join", [(0.0, 0.5), (0.0, 0.5, 0.4), (0.0, 0.5, 1.0), (-0.1, 0.0, 0.1)])
def test_times_of_joining_that_do_not_fit_are_refused(join: tuple[float, ...]) -> None:
    with pytest.raises(UsageError, match=r"motion: join is .*; allowed: "):
        options_of(
            "gsdmsr_cli.model.motion",
            {"name": "cells", "splats": [20, 10, 5], "join": list(join)},
        )
