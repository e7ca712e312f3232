"""Values of single times: what the times that no view has shown yet are given."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gsdmsr_cli.model.motion._grids import between, sparser_at_ends
from gsdmsr_cli.model.parameter import NO_TIMES, Parameter, evenly, name_parameters
from gsdmsr_cli.ops import planes
from gsdmsr_cli.ops.planes.levels import cubic_weights

TIMES = [0.0, 0.25, 0.5, 0.75, 1.0]


@pytest.mark.parametrize(
    ("first", "last", "expected"),
    [
        (0.0, 1.0, [0, 1, 2, 3, 4]),
        (0.5, 0.5, [2, 2, 2, 2, 2]),
        (0.3, 0.6, [1, 1, 2, 3, 3]),  # 0.3 lies between the second and the third
        (0.25, 0.75, [1, 1, 2, 3, 3]),
        (0.0, 0.1, [0, 1, 1, 1, 1]),
        (1.0, 1.0, [4, 4, 4, 4, 4]),
    ],
)
@pytest.mark.parametrize("axis", [0, 1])
def test_times_outside_are_as_the_nearest_that_count_within(
    first: float, last: float, expected: list[float], axis: int
) -> None:
    values = torch.arange(5.0).expand(3, 5) if axis else torch.arange(5.0)
    parameter = Parameter("x", values.clone(), rate="planes", time_axis=axis)
    parameter.hold_outside(first, last)
    assert torch.equal(parameter.tensor.detach(), torch.tensor(expected).expand_as(values))


@settings(deadline=None)
@given(
    st.integers(2, 9), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.sampled_from([1, 0.5])
)
def test_what_is_shown_stays_and_what_is_not_stands_still(
    nodes: int, one: float, other: float, time: float, ends: float
) -> None:
    place = sparser_at_ends(ends)
    first, last = sorted((one, other))
    before = torch.rand(nodes, generator=torch.Generator().manual_seed(nodes))
    parameter = Parameter("x", before.clone(), rate="planes", time_axis=0, time_place=place)
    parameter.hold_outside(first, last)
    after, first, last, time = parameter.tensor.detach(), place(first), place(last), place(time)
    if first <= time <= last:
        torch.testing.assert_close(between(after, time), between(before, time))
    cell = 1 / (nodes - 1)
    if time >= last + cell:
        torch.testing.assert_close(between(after, time), after[-1])
    if time <= first - cell:
        torch.testing.assert_close(between(after, time), after[0])


@settings(deadline=None)
@given(st.integers(2, 9), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1))
def test_of_a_cubic_curve_what_is_shown_stays_as_well(
    nodes: int, one: float, other: float, time: float
) -> None:
    first, last = sorted((one, other))
    before = torch.rand(nodes, dtype=torch.float64, generator=torch.Generator().manual_seed(nodes))
    parameter = Parameter("x", before.clone(), rate="planes", time_axis=0, time_degree=3)
    parameter.hold_outside(first, last)
    after, place = parameter.tensor.detach(), torch.tensor(time * (nodes - 1), dtype=torch.float64)
    weights = cubic_weights(place, nodes)
    if first <= time <= last:
        torch.testing.assert_close(weights @ after, weights @ before)
    cell = 1 / (nodes - 1)
    if time >= last + 3 * cell:
        torch.testing.assert_close(weights @ after, after[-1])
    if time <= first - 3 * cell:
        torch.testing.assert_close(weights @ after, after[0])


@settings(deadline=None)
@given(st.floats(0.01, 1), st.floats(0, 1), st.floats(0, 1))
def test_nodes_are_sparser_at_both_ends(density: float, one: float, other: float) -> None:
    place = sparser_at_ends(density)
    assert (place(0), place(1)) == pytest.approx((0, 1)) and place(0.5) == 0.5
    before, after = sorted((one, other))
    assert 0 <= place(before) <= place(after) + 1e-15 <= 1 + 2e-15, "times keep their order"
    step = 1e-6
    for slope in (place(step) / step, (1 - place(1 - step)) / step):
        assert slope == pytest.approx(density, abs=1e-4)
    assert sparser_at_ends(1.0) is evenly


def test_without_times_nothing_changes() -> None:
    parameter = Parameter("x", torch.arange(5.0), rate="planes")
    parameter.hold_outside(0.5, 0.5)
    assert torch.equal(parameter.tensor.detach(), torch.arange(5.0))


def test_a_level_has_times_and_a_plane_of_space_has_none() -> None:
    level = planes.new_level(4, 6, 16, torch.Generator())
    space, time = name_parameters("grid", [level], "planes", planes.TIME_AXES)
    assert space.time_axis is None and time.time_axis is not None
    assert time.tensor.shape[time.time_axis] == 6
    assert not NO_TIMES
