"""Colours of directions on the faces of a cube by CUDA kernels are their twins in float64."""

from __future__ import annotations

import pytest
from cube_map_checks import SIZES, compare

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (33, 19), (129, 7)])
def test_pictures_and_gradients(place: str, size: int, width: int, height: int) -> None:
    compare(size, width, height, place)
