"""Values that are not finite are found, wherever they are."""

from __future__ import annotations

import math

import pytest
import torch

from gsdmsr_cli.ops.finite import all_finite, finite_rows, not_finite

VALUES = pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])


@VALUES
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("count", [1, 7, 16, 1000])
def test_a_single_value_is_found_wherever_it_is(
    count: int, dtype: torch.dtype, value: float
) -> None:
    """float32 goes to the kernel, float64 to torch."""
    tensors = [torch.full((count,), 3e38, dtype=dtype), torch.zeros(5, 3, dtype=dtype)]
    assert all_finite(tensors) and not_finite(tensors) == 0
    for place in {0, count // 2, count - 1}:
        wrong = tensors[0].clone()
        wrong[place] = value
        assert not all_finite([tensors[1], wrong]), place
        assert not_finite([tensors[1], wrong]).isnan(), place


def test_rows_are_finite_if_all_of_their_values_are() -> None:
    """Of vectors, matrices, indices, and tensors that only have rows of splats that move."""
    vector = torch.tensor([1.0, math.nan, 1.0, 1.0])
    matrix = torch.zeros(4, 2, 3)
    matrix[2, 1, 0] = math.inf
    few = torch.tensor([[-math.inf], [0.0]])
    given = [vector, matrix, few, torch.arange(4), torch.zeros(0, 16)]
    assert finite_rows(given, 4).tolist() == [False, False, False, True]
