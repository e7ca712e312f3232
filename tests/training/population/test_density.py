"""Density control on cases small enough to follow by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from kernel_checks import generator

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import covariance
from gsdmsr_cli.options.preset import DensityOptions
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.population.density import gradient_at, grow_and_prune
from gsdmsr_cli.training.resizing import SPLIT_SHRINK
from gsdmsr_cli.training.statistics import DensityStatistics

RADIUS = 2.0
OPTIONS = DensityOptions(
    gradient=1e-3, split_scale=0.05, prune_scale=0.5, prune_opacity=0.01, cap=1000
)
SMALL, LARGE, HUGE = 0.02, 0.4, 1.5  # below split, above split, above prune [world units]


def splats_of(scales: list[float], opacity: float = 0.5) -> Splats:
    """Return splats that differ in every tensor; ``scales`` are the largest of the three axes."""
    n, rng = len(scales), generator(1)
    shrink = torch.tensor([1.0, 0.5, 0.25])
    return Splats(
        means=torch.randn(n, 3, generator=rng),
        quats=torch.randn(n, 4, generator=rng),
        log_scales=(torch.tensor(scales)[:, None] * shrink).log(),
        logit_opacities=torch.full((n,), math.log(opacity / (1 - opacity))),
        sh=torch.randn(n, 4, 3, generator=rng),
    )


def statistics_of(means: list[float]) -> DensityStatistics:
    statistics = DensityStatistics(len(means))
    statistics.total, statistics.views = torch.tensor(means) * 3, torch.full((len(means),), 3.0)
    return statistics


def grown(
    splats: Splats, gradients: list[float], options: DensityOptions = OPTIONS, growing: bool = True
) -> tuple[list[int], list[bool], Splats]:
    change = grow_and_prune(
        splats, statistics_of(gradients), options, RADIUS, growing, generator(7)
    )
    assert change.splats is not None
    assert len(change.rows) == len(change.fresh) == len(change.splats)
    return change.rows.tolist(), change.fresh.tolist(), change.splats


def test_a_small_splat_that_a_layer_wants_split_is_split_if_it_grows() -> None:
    splats, wanted = splats_of([SMALL, SMALL, SMALL]), torch.tensor([True, True, False])
    given = statistics_of([0.0, 5e-3, 5e-3]), OPTIONS, RADIUS, True, generator(7), wanted
    change = grow_and_prune(splats, *given)
    assert change.rows.tolist() == [0, 2, 2, 1, 1]
    assert change.fresh.tolist() == [False, False, True, True, True]
    assert change.split is not None and change.split.tolist() == [False] * 3 + [True] * 2


def test_nothing_changes_below_the_threshold() -> None:
    splats = splats_of([SMALL, LARGE, SMALL])
    rows, fresh, after = grown(splats, [9e-4, 9e-4, 0.0])
    assert rows == [0, 1, 2] and not any(fresh)
    for name, tensor in after.tensors().items():
        assert torch.equal(tensor, splats.tensors()[name]), name


def test_a_small_splat_is_cloned_where_it_is() -> None:
    splats = splats_of([SMALL, LARGE, SMALL])
    rows, fresh, after = grown(splats, [0.0, 0.0, 2e-3])
    assert rows == [0, 1, 2, 2] and fresh == [False, False, False, True]
    for name, tensor in after.tensors().items():
        assert torch.equal(tensor, splats.tensors()[name][rows]), name


def test_a_large_splat_gives_way_to_two_smaller_ones() -> None:
    splats = splats_of([SMALL, LARGE, SMALL])
    rows, fresh, after = grown(splats, [0.0, 2e-3, 0.0])
    assert rows == [0, 2, 1, 1] and fresh == [False, False, True, True]
    for name, tensor in after.tensors().items():
        parents = splats.tensors()[name][rows]
        assert torch.equal(tensor[:2], parents[:2]), name
        if name not in ("means", "log_scales"):
            assert torch.equal(tensor, parents), name
    shrunk = splats.log_scales[[1, 1]] - math.log(SPLIT_SHRINK)
    torch.testing.assert_close(after.log_scales[2:], shrunk)
    assert not torch.equal(after.means[2], after.means[3])
    assert (after.means[2:] - splats.means[1]).norm(dim=1).max() < 5 * LARGE


def test_sizes_are_compared_in_units_of_the_scenes_radius() -> None:
    """Of radius 2: split above 0.1, pruned above 1; each size lies within 5 % of a threshold."""
    rows, fresh, after = grown(splats_of([0.095, 0.105, 0.95, 1.05]), [1.0, 1.0, 0.0, 1.0])
    assert rows == [0, 2, 0, 1, 1] and fresh == [False, False, True, True, True]
    sizes = after.log_scales.exp().amax(dim=1)
    child = 0.105 / SPLIT_SHRINK
    torch.testing.assert_close(sizes, torch.tensor([0.095, 0.95, 0.095, child, child]))


def test_children_are_drawn_from_their_parents_gaussian() -> None:
    one = splats_of([LARGE])
    splats = one.take(torch.zeros(4000, dtype=torch.long))
    options = replace(OPTIONS, cap=10000)
    rows, fresh, after = grown(splats, [1.0] * 4000, options)
    assert sorted(rows) == [i for i in range(4000) for _ in range(2)] and all(fresh)
    offsets = (after.means - one.means).double()
    exact = covariance(one.quats.double(), one.log_scales.double())[0]
    # in the parent's principal axes, offsets over the scales are standard normal
    whitened = torch.linalg.solve_triangular(torch.linalg.cholesky(exact), offsets.T, upper=False)
    assert whitened.mean(dim=1).abs().max() < 0.05
    torch.testing.assert_close(torch.cov(whitened), torch.eye(3).double(), atol=0.06, rtol=0)


def test_children_depend_on_the_generator_only() -> None:
    splats = splats_of([LARGE, LARGE])
    one, two = (grown(splats, [1.0, 1.0])[2] for _ in range(2))
    assert torch.equal(one.means, two.means)


def test_faint_and_huge_splats_are_pruned_even_if_they_would_grow() -> None:
    splats = splats_of([SMALL, HUGE, LARGE, SMALL])
    splats.logit_opacities[0] = math.log(0.009 / 0.991)
    splats.logit_opacities[3] = math.log(0.011 / 0.989)
    rows, fresh, _ = grown(splats, [1.0, 1.0, 0.0, 0.0])
    assert rows == [2, 3] and not any(fresh)


def test_once_growing_has_ended_huge_splats_stay_since_nothing_would_take_their_place() -> None:
    splats = splats_of([SMALL, HUGE, LARGE, SMALL])
    splats.logit_opacities[0] = math.log(0.009 / 0.991)
    rows, fresh, _ = grown(splats, [1.0, 1.0, 0.0, 0.0], growing=False)
    assert rows == [1, 2, 3] and not any(fresh)


def test_without_growing_large_gradients_do_nothing() -> None:
    rows, fresh, _ = grown(splats_of([SMALL, LARGE]), [1.0, 1.0], growing=False)
    assert rows == [0, 1] and not any(fresh)


def test_at_the_cap_the_largest_gradients_grow() -> None:
    splats = splats_of([SMALL, SMALL, LARGE, SMALL, LARGE])
    gradients = [2e-3, 5e-3, 4e-3, 0.0, 3e-3]
    rows, _, after = grown(splats, gradients, replace(OPTIONS, cap=7))
    assert len(after) == 7
    assert rows == [0, 1, 3, 4, 1, 2, 2]
    for cap in (1, 5):
        assert grown(splats, gradients, replace(OPTIONS, cap=cap))[0] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("name", list(splats_of([SMALL]).tensors()))
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_rows_that_are_not_finite_die(name: str, value: float) -> None:
    splats = splats_of([SMALL, SMALL, SMALL])
    splats.tensors()[name][1].view(-1)[-1] = value
    rows, _, after = grown(splats, [0.0, 1.0, 0.0])
    assert rows == [0, 2]
    assert all(tensor.isfinite().all() for tensor in after.tensors().values())


def test_all_may_die() -> None:
    rows, fresh, after = grown(splats_of([HUGE, HUGE]), [1.0, 1.0])
    assert rows == [] and fresh == [] and len(after) == 0


def test_the_parents_stay_as_they_are() -> None:
    splats = splats_of([LARGE, SMALL])
    before = splats.map(torch.Tensor.clone)
    grown(splats, [1.0, 1.0])
    for name, tensor in splats.tensors().items():
        assert torch.equal(tensor, before.tensors()[name]), name


@pytest.mark.parametrize(
    ("step", "progress", "share"),
    [
        (2000, 0.2, 1.0),  # of 10,000 steps
        (2000, 0.1, 1.0),  # of 20,000, as many as it is for
        (2000, 0.025, 0.5),  # of 80,000
        (8000, 0.1, 0.5),
        (1, 0.0, 1.0),  # nothing is known yet
    ],
)
def test_the_threshold_falls_with_the_square_root_of_the_length(
    step: int, progress: float, share: float
) -> None:
    tick, options = Tick(step, progress), replace(OPTIONS, long_from=20000)
    assert gradient_at(options, tick) == pytest.approx(share * OPTIONS.gradient)
    assert gradient_at(OPTIONS, tick) == OPTIONS.gradient
