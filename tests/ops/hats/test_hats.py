"""Shares of nodes are those of straight lines, and a kernel's are those of plain torch."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kernel_checks import assert_near, generator

from gsdmsr_cli.ops.hats import cuda, hats, hats_twin

within = st.floats(-0.2, 1.2)


@given(times=st.lists(within, min_size=1, max_size=8), nodes=st.integers(2, 40))
def test_values_at_times_lie_on_straight_lines_between_the_nodes(
    times: list[float], nodes: int
) -> None:
    values = torch.randn(nodes, generator=generator(), dtype=torch.float64)
    found = hats(times, values) @ values
    for time, value in zip(times, found.tolist(), strict=True):
        place = min(max(time, 0.0), 1.0) * (nodes - 1)
        before = min(int(place), nodes - 2)
        a, b = values[before : before + 2].tolist()
        assert value == pytest.approx(a + (b - a) * (place - before), abs=1e-9)


@pytest.mark.usefixtures("kernels_on_the_cpu")
@pytest.mark.parametrize("nodes", [2, 20, 300])
@pytest.mark.parametrize("times", [[0.0], [1.0, 0.3, -0.1, 1.1], [i / 7 for i in range(8)]])
def test_a_kernel_has_the_same(place: str, times: list[float], nodes: int) -> None:
    values = torch.zeros(nodes)
    truth = hats_twin(times, values.double())
    # a time that is rounded lies up to nodes / 2^24 elsewhere
    assert_near(cuda.hats(times, values.to(place)).cpu(), truth, 1e-7 * nodes, "shares")


@pytest.mark.parametrize("nodes", [2, 300])
def test_a_cpu_has_the_same(nodes: int) -> None:
    times, values = [0.0, 0.3, 0.77, 1.0, -0.1, 1.1], torch.zeros(nodes)
    truth = hats_twin(times, values.double())
    assert_near(hats(times, values), truth, 1e-7 * nodes, "shares")


def test_more_times_than_a_kernel_is_told_of_are_refused() -> None:
    with pytest.raises(ValueError, match="17 times; at most 16 are asked for at once"):
        cuda.hats([0.5] * 17, torch.zeros(3))
