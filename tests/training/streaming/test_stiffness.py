"""Neighbours of a stream: rigid moves cost nothing, others what the paper's equations say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_checks import generator
from motion_checks import splats_of
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_product
from gsdmsr_cli.options.sequences import StreamOptions
from gsdmsr_cli.training.streaming.stiffness import Compared, Stiffness, graph_of

COUNT, NEAR = 200, 6


def quat_of(rotation: Rotation) -> torch.Tensor:
    return torch.from_numpy(np.roll(rotation.as_quat(), 1)).float()


def turned(splats: Splats, rotation: Rotation, shift: float) -> Splats:
    """Return the splats as parts of one rigid body."""
    matrix = torch.from_numpy(rotation.as_matrix()).float()
    quats = quat_product(quat_of(rotation).expand(COUNT, 4), splats.quats)
    return replace(splats, means=splats.means @ matrix.mT + shift, quats=quats)


def only(**weights: float) -> Stiffness:
    none = {"rigidity": 0.0, "rotation_similarity": 0.0, "isometry": 0.0}
    return Stiffness(StreamOptions(**{**none, **weights}, neighbours=NEAR, samples=COUNT))


def test_neighbours_are_the_nearest_and_a_splat_does_not_count_as_its_own() -> None:
    means = splats_of(COUNT).means
    graph = graph_of(means, NEAR)
    assert graph is not None
    distances, near = cKDTree(means.double().numpy()).query(means.double().numpy(), NEAR + 1)
    assert np.array_equal(np.sort(graph.near.numpy(), axis=1), np.sort(near, axis=1))
    size = np.sqrt((distances[:, 1:] ** 2).mean())
    assert float(graph.size) == pytest.approx(size, rel=1e-5)
    expected = np.exp(-(distances[:, 1:] ** 2) / (2 * size**2)).sum(axis=1)
    np.testing.assert_allclose(graph.weights.sum(dim=1).numpy(), expected, rtol=1e-4)


@pytest.mark.parametrize("name", ["rigidity", "rotation_similarity", "isometry"])
def test_a_rigid_move_costs_nothing(name: str) -> None:
    first = splats_of(COUNT)
    before = turned(first, Rotation.from_rotvec([0.3, -0.2, 0.5]), 0.2)
    now = turned(before, Rotation.from_rotvec([-0.1, 0.4, 0.2]), -0.5)
    value = only(**{name: 1.0})(Compared(now, before, first), generator())
    assert value is not None and float(value) < 1e-4


def test_what_stretches_costs_its_stretching() -> None:
    """All distances half as long again: the mean weighted distance, halved."""
    first = splats_of(COUNT)
    now = replace(first, means=1.5 * first.means)
    graph = graph_of(first.means, NEAR)
    assert graph is not None
    lengths = (first.means[graph.near] - first.means[:, None]).norm(dim=2)
    expected = 0.5 * (graph.weights * lengths).sum() / graph.weights.sum() / graph.size
    for name in ("rigidity", "isometry"):
        value = only(**{name: 2.0})(Compared(now, first, first), generator())
        torch.testing.assert_close(value, 2 * expected)


def test_rotations_that_differ_cost_the_distance_of_their_quaternions() -> None:
    first = splats_of(COUNT)
    odd = torch.arange(COUNT) % 2 == 1
    turn = torch.where(odd[:, None], quat_of(Rotation.from_rotvec([0, 0, 0.8])), torch.eye(4)[0])
    now = replace(first, quats=quat_product(turn, first.quats))
    graph = graph_of(first.means, NEAR)
    assert graph is not None
    differ = odd[graph.near] != odd[:, None]
    apart = float((quat_of(Rotation.from_rotvec([0, 0, 0.8])) - torch.eye(4)[0]).norm())
    expected = apart * (graph.weights * differ).sum() / graph.weights.sum()
    value = only(rotation_similarity=1.0)(Compared(now, first, first), generator())
    torch.testing.assert_close(value, expected, rtol=1e-4, atol=1e-5)


def test_isometry_is_to_the_first_moment_and_rigidity_to_the_last() -> None:
    first = splats_of(COUNT)
    stretched = replace(first, means=1.5 * first.means)
    compared = Compared(stretched, stretched, first)
    assert float(only(rigidity=1.0)(compared, generator()) or 0) < 1e-4
    assert float(only(isometry=1.0)(compared, generator()) or 0) > 0.1


def test_the_same_generator_chooses_the_same_splats() -> None:
    first = splats_of(COUNT)
    noisy = replace(first, means=first.means + 0.1 * torch.randn(COUNT, 3, generator=generator(1)))
    some = Stiffness(StreamOptions(neighbours=NEAR, samples=20))
    values = [some(Compared(noisy, first, first), generator(seed)) for seed in (4, 4, 5)]
    assert torch.equal(values[0], values[1]) and not torch.equal(values[0], values[2])


def test_nothing_is_asked_of_one_splat_or_with_weights_of_zero() -> None:
    one = splats_of(1)
    assert only(rigidity=1.0)(Compared(one, one, one), generator()) is None
    assert not only() and only(isometry=0.1)
