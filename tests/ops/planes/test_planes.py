"""Plane grids: the twin against hat functions, the kernels against the twin."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import assert_near, assert_same_on_threads, generator, leaves
from scipy.interpolate import BSpline
from torch import Tensor

from gsdmsr_cli.ops import planes
from gsdmsr_cli.ops.planes import Level
from gsdmsr_cli.ops.planes import cpu as kernels
from gsdmsr_cli.ops.planes.levels import cubic_weights

PAIRS = ((0, 1), (0, 2), (1, 2))

Sizes = list[tuple[int, int, int]]  # resolution, times, channels of each level

sizes = st.lists(
    st.tuples(st.integers(2, 9), st.integers(2, 6), st.sampled_from([16, 32])),
    min_size=1,
    max_size=3,
)
times = st.floats(-1, 1, width=32)
degrees = st.sampled_from(planes.DEGREES)


def tensors_of(shapes: Sizes, seed: int = 0) -> list[Tensor]:
    """Return space and time of each level, uniform in [-1, 2] so that signs and |1 - x| differ."""
    rng, tensors = generator(seed), []
    for resolution, moments, channels in shapes:
        level = planes.new_level(resolution, moments, channels, rng)
        tensors += [torch.rand(tensor.shape, generator=rng) * 3 - 1 for tensor in level]
    return tensors


def levels_of(tensors: list[Tensor]) -> list[Level]:
    return [Level(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]


def points_of(count: int, seed: int = 0) -> Tensor:
    """Return points in [-1.2, 1.2]^3, so that some lie outside of the box."""
    return torch.rand(count, 3, generator=generator(seed + 1000)) * 2.4 - 1.2


def hats(coordinates: Tensor, resolution: int) -> Tensor:
    """Return (N, resolution) values of the grid points' hat functions at coordinates in [-1, 1]."""
    positions = (coordinates.clamp(-1, 1) + 1) / 2 * (resolution - 1)
    return (1 - (positions[:, None] - torch.arange(resolution)).abs()).clamp(min=0)


def by_hats(level: Level, points: Tensor, time: float) -> Tensor:
    """Return the features as products of sums over all grid points."""
    resolution, moments = level.time.shape[3], level.time.shape[2]
    along = [hats(points[:, axis], resolution) for axis in range(3)]
    when = hats(torch.full((len(points),), time, dtype=points.dtype), moments)
    features = points.new_ones(len(points), level.channels)
    for plane, (x, y) in zip(level.space, PAIRS, strict=True):
        sample = torch.einsum("cyxl,ny,nx->ncl", plane, along[y], along[x])
        features = features * sample.flatten(1)
    for axis, plane in enumerate(level.time):
        sample = torch.einsum("ctxl,nt,nx->ncl", plane, when, along[axis])
        features = features * sample.flatten(1)
    return features


@given(sizes, st.integers(1, 9), times)
@settings(max_examples=20, deadline=None)
def test_twin_is_a_product_of_hat_functions(shapes: Sizes, count: int, time: float) -> None:
    levels = levels_of([t.double() for t in tensors_of(shapes)])
    points = points_of(count).double()
    expected = torch.cat([by_hats(level, points, time) for level in levels], dim=1)
    torch.testing.assert_close(planes.lookup_twin(levels, points, time), expected)


def continued(nodes: np.ndarray) -> BSpline:
    """The cubic B-spline of nodes at 0, 1, ... by scipy, continued straight on both sides."""
    before, after = 2 * nodes[:1] - nodes[1:2], 2 * nodes[-1:] - nodes[-2:-1]
    knots = np.arange(-3, len(nodes) + 3, dtype=float)
    return BSpline(knots, np.concatenate([before, nodes, after]), 3)


@given(st.integers(2, 9), st.floats(0, 1))
@settings(max_examples=60, deadline=None)
def test_cubic_weights_are_those_of_a_natural_spline(count: int, share: float) -> None:
    nodes, place = np.random.default_rng(count).normal(size=count), share * (count - 1)
    weights = cubic_weights(torch.tensor(place, dtype=torch.float64), count).numpy()
    curve = continued(nodes)
    assert weights @ nodes == pytest.approx(float(curve(place)), abs=1e-12)
    for end in (0, count - 1):
        assert curve(end) == pytest.approx(nodes[end])
        assert curve(end, nu=2) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("degree", planes.DEGREES)
def test_twin_passes_gradcheck(degree: int) -> None:
    tensors = leaves(tensors_of([(3, 4, 16)]), torch.float64)
    points = (points_of(2).double() * 0.7).requires_grad_()

    def few(points: Tensor, *tensors: Tensor) -> Tensor:
        levels = levels_of(list(tensors))
        return planes.lookup_twin(levels, points, 0.3, degree=degree)[:, ::5]

    assert torch.autograd.gradcheck(few, (points, *tensors))


@given(sizes, st.integers(1, 9) | st.just(333), times, st.integers(0, 99), degrees)
@settings(max_examples=60, deadline=None)
def test_lookup_matches_the_twin(
    shapes: Sizes, count: int, time: float, seed: int, degree: int
) -> None:
    start = [points_of(count, seed), *tensors_of(shapes, seed)]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = planes.lookup_at_times(levels_of(ours[1:]), ours[0], [time], degree=degree)
    truth = planes.lookup_twin(levels_of(exact[1:]), exact[0], time, degree=degree)
    assert found.shape == (count, sum(channels for _, _, channels in shapes))
    assert_near(found, truth, 1e-5, "features")
    weights = torch.randn(found.shape, generator=generator(seed))
    (found * weights).sum().backward()
    (truth * weights).sum().backward()
    for i, (a, b) in enumerate(zip(ours, exact, strict=True)):
        assert_near(a.grad, b.grad, 1e-4, f"gradient {i}")


@pytest.mark.parametrize("look", [planes.lookup, planes.lookup_twin])
def test_a_box_is_stretched_to_the_cube(look: Any) -> None:
    lower, upper = torch.tensor([-3.0, 0.5, 1.0]), torch.tensor([-1.0, 0.6, 9.0])
    tensors = tensors_of([(5, 4, 16), (3, 2, 16)])
    found, true = leaves(tensors, torch.float32), leaves(tensors, torch.float32)
    inside = points_of(30).requires_grad_()
    points = (lower + (inside.detach() + 1) / 2 * (upper - lower)).requires_grad_()
    box = ((-3.0, 0.5, 1.0), (-1.0, 0.6, 9.0))
    features, expected = (
        look(levels_of(found), points, 0.3, box),
        look(levels_of(true), inside, 0.3),
    )
    assert_near(features, expected, 1e-4, "features")
    features.square().sum().backward()
    expected.square().sum().backward()
    assert points.grad is not None and inside.grad is not None
    assert_near(points.grad * (upper - lower) / 2, inside.grad, 1e-3, "gradient of the points")
    for a, b in zip(found, true, strict=True):
        assert_near(a.grad, b.grad, 1e-3, "gradient")


@pytest.mark.parametrize("count", [1, 40])
def test_features_that_points_bring_along_are_the_last_columns(count: int) -> None:
    start = [points_of(count), torch.randn(count, 16), *tensors_of([(5, 4, 16), (3, 2, 32)])]
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = planes.lookup(levels_of(ours[2:]), ours[0], 0.3, planes.CUBE, ours[1])
    truth = planes.lookup_twin(levels_of(exact[2:]), exact[0], 0.3, planes.CUBE, exact[1])
    assert torch.equal(found[:, 48:], ours[1])
    weights = torch.randn(found.shape, generator=generator(1))
    (found * weights).sum().backward()
    (truth * weights).sum().backward()
    assert_near(found, truth, 1e-5, "features")
    for i, (a, b) in enumerate(zip(ours, exact, strict=True)):
        assert_near(a.grad, b.grad, 1e-4, f"gradient {i}")


@pytest.mark.parametrize("look", [planes.lookup, planes.lookup_twin])
def test_no_points_have_no_features_and_give_no_gradient(look: Any) -> None:
    tensors = leaves(tensors_of([(3, 4, 16), (5, 2, 32)]), torch.float32)
    features = look(levels_of(tensors), torch.zeros(0, 3), 0.2)
    assert features.shape == (0, 48)
    features.sum().backward()
    for tensor in tensors:
        assert tensor.grad is not None and not tensor.grad.any()


def test_gradients_of_few_rows_belong_to_their_points() -> None:
    """Which only those rows go through; the others' are zero."""
    start, live = [points_of(200), *tensors_of([(5, 4, 16), (3, 2, 16)])], [3, 40, 41, 199]
    slope = torch.zeros(200, 32)
    slope[live] = torch.randn(4, 32, generator=generator(4))
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    planes.lookup(levels_of(ours[1:]), ours[0], 0.3).backward(slope)
    planes.lookup_twin(levels_of(exact[1:]), exact[0], 0.3).backward(slope.double())
    for i, (a, b) in enumerate(zip(ours, exact, strict=True)):
        assert_near(a.grad, b.grad, 1e-4, f"gradient {i}")
    assert ours[0].grad is not None
    assert (ours[0].grad != 0).any(dim=1).nonzero().flatten().tolist() == live


def test_lookup_without_a_gradient_of_the_points() -> None:
    start, points = tensors_of([(5, 4, 16)]), points_of(7)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    planes.lookup(levels_of(ours), points, 0.3).sum().backward()
    planes.lookup_twin(levels_of(exact), points.double(), 0.3).sum().backward()
    assert points.grad is None
    for a, b in zip(ours, exact, strict=True):
        assert_near(a.grad, b.grad, 1e-5, "gradient")


@pytest.mark.parametrize("look", [planes.lookup, planes.lookup_twin])
def test_points_outside_the_box_are_clamped_and_get_no_gradient(look: Any) -> None:
    levels = levels_of(tensors_of([(5, 4, 16)]))
    far = torch.tensor([[3.0, 0.2, -0.4], [0.1, -1e30, 0.3], [-9.0, 7.0, float("inf")]])
    outside = far.abs() > 1
    inside = far.clamp(-1, 1)
    far.requires_grad_()
    features = look(levels, far, 0.1)
    assert torch.equal(features, look(levels, inside, 0.1))
    features.sum().backward()
    assert far.grad is not None
    assert not far.grad[outside].any()
    assert far.grad[~outside].all()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("look", [planes.lookup, planes.lookup_twin])
def test_points_that_are_nowhere_add_nothing_where_nothing_is_to_be_learnt(
    look: Any, value: float
) -> None:
    """Few of many, so that rows without a gradient are not left out of the backward pass."""
    points, nowhere = points_of(40), torch.tensor([3, 17, 38])
    points[nowhere, torch.tensor([0, 1, 2])] = value
    there = torch.ones(40, dtype=torch.bool).index_fill_(0, nowhere, False)
    results = []
    for rows in (slice(None), there):
        given, *tensors = leaves(
            [points[rows], *tensors_of([(5, 4, 16), (3, 2, 32)])], torch.float32
        )
        features = look(levels_of(tensors), given, 0.3)
        features.backward(there[rows, None].float().expand_as(features))
        results.append((given.grad, features, [tensor.grad for tensor in tensors]))
    (d_points, found, shared), (d_finite, expected, alone) = results
    assert torch.equal(found[there], expected)
    assert torch.equal(d_points[there], d_finite) and not d_points[nowhere].any()
    for ours, truth in zip(shared, alone, strict=True):
        assert torch.equal(ours, truth)


@pytest.mark.parametrize("look", [planes.lookup, planes.lookup_twin])
def test_times_outside_are_those_at_the_ends(look: Any) -> None:
    levels, points = levels_of(tensors_of([(5, 4, 16)])), points_of(6)
    assert torch.equal(look(levels, points, 1.7), look(levels, points, 1.0))
    assert torch.equal(look(levels, points, -3.0), look(levels, points, -1.0))
    assert not torch.equal(look(levels, points, -1.0), look(levels, points, 1.0))


@given(st.integers(2, 7), st.integers(2, 5), times, st.booleans())
@settings(max_examples=40, deadline=None)
def test_time_collapses_to_a_line_and_spreads_as_the_adjoint(
    moments: int, size: int, time: float, cubic: bool
) -> None:
    rng = np.random.default_rng(moments)
    grid = rng.normal(size=(3, 2, moments, size, 16)).astype(np.float32)
    lines, d_grid = np.empty((3, 2, size, 16), np.float32), np.empty_like(grid)
    chunks = [(axis, chunk) for axis in range(3) for chunk in range(2)]
    for place in chunks:
        kernels.collapse(grid, np.float32(time), cubic, lines, *place)
    if cubic:
        expected = continued(grid.astype(float).transpose(2, 0, 1, 3, 4))(
            (time + 1) / 2 * (moments - 1)
        )
    else:
        weights = hats(torch.tensor([time], dtype=torch.float64), moments)[0].numpy()
        expected = np.einsum("t,actrk->acrk", weights, grid)
    # the place in time is rounded twice, its error counts as the steepest slope; so is the result,
    # of which a cubic curve has up to four parts, whose weights are sums of powers
    slope, largest = np.abs(np.diff(grid, axis=2)).max(), np.abs(grid).max()
    rounding = np.finfo(np.float32).eps * ((moments - 1) * slope + (12 if cubic else 2) * largest)
    np.testing.assert_allclose(lines, expected, atol=rounding)
    d_lines = rng.normal(size=lines.shape).astype(np.float32)
    for place in chunks:
        kernels.spread(d_lines, np.float32(time), cubic, d_grid, *place)
    forward, backward = np.vdot(d_lines, lines), np.vdot(d_grid, grid)
    assert forward == pytest.approx(backward, rel=1e-4, abs=1e-4)


@given(sizes, st.tuples(*[st.sampled_from([0.0, 0.3, 2.0])] * 3), st.sampled_from([1.0, -2.5]))
@settings(max_examples=40, deadline=None)
def test_penalty_matches_the_twin(
    shapes: Sizes, weights: tuple[float, float, float], scale: float
) -> None:
    start = tensors_of(shapes)
    ours, exact = leaves(start, torch.float32), leaves(start, torch.float64)
    found = planes.penalty(levels_of(ours), *weights)
    truth = planes.penalty_twin(levels_of(exact), *weights)
    assert found.item() == pytest.approx(truth.item(), rel=1e-5, abs=1e-9)
    (scale * found).backward()
    (scale * truth).backward()
    for i, (a, b) in enumerate(zip(ours, exact, strict=True)):
        assert_near(a.grad, b.grad, 1e-5, f"gradient {i}")


@pytest.mark.parametrize("compute", [planes.penalty, planes.penalty_twin])
def test_penalty_of_ramps_is_as_computed_by_hand(compute: object) -> None:
    """Slopes of 0.5 a grid point in x and 0.25 in y; time runs as t^2 from 1 and bends by 2."""
    assert callable(compute)
    resolution, moments = 5, 4
    steps = torch.arange(resolution) * 0.5 + torch.arange(resolution)[:, None] * 0.25
    space = steps[None, None, :, :, None].expand(3, 1, -1, -1, 16).contiguous()
    curve = 1.0 + torch.arange(moments) ** 2
    time = curve[None, None, :, None, None].expand(3, 1, -1, resolution, 16).contiguous()
    level = [Level(space, time)]
    assert float(compute(level, 1.0, 0.0, 0.0)) == pytest.approx(3 * (0.5**2 + 0.25**2))
    assert float(compute(level, 0.0, 1.0, 0.0)) == pytest.approx(3 * 2.0**2)
    assert float(compute(level, 0.0, 0.0, 1.0)) == pytest.approx(3 * (0 + 1 + 4 + 9) / 4)
    assert float(compute(level, 2.0, 3.0, 5.0)) == pytest.approx(
        2 * 3 * 0.3125 + 3 * 12 + 5 * 3 * 3.5
    )


def test_new_level_starts_as_4d_gs_does() -> None:
    level = planes.new_level(20, 7, 32, generator())
    assert level.space.shape == (3, 2, 20, 20, 16) and level.time.shape == (3, 2, 7, 20, 16)
    assert level.channels == 32
    assert torch.equal(level.time, torch.ones_like(level.time))
    assert level.space.min() >= 0.1 and level.space.max() <= 0.5
    assert float(level.space.mean()) == pytest.approx(0.3, abs=0.01)
    assert torch.equal(level.space, planes.new_level(20, 7, 32, generator()).space)


@pytest.mark.parametrize("arguments", [(1, 4, 16), (4, 1, 16), (4, 4, 8), (4, 4, 0)])
def test_new_level_refuses_sizes_that_kernels_cannot_serve(arguments: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="multiple of 16 channels and at least 2 nodes"):
        planes.new_level(*arguments, generator())


def test_results_do_not_depend_on_the_number_of_threads() -> None:
    start = [points_of(333), *tensors_of([(9, 5, 32), (16, 4, 16)])]

    def compute() -> list[Tensor]:
        ours = leaves(start, torch.float32)
        levels = levels_of(ours[1:])
        features = planes.lookup(levels, ours[0], 0.3)
        value = planes.penalty(levels, 0.3, 0.5, 0.7)
        (features.square().sum() + value).backward()
        return [features, value, *(t.grad for t in ours if t.grad is not None)]

    assert len(compute()) == 2 + 5
    assert_same_on_threads(compute)
