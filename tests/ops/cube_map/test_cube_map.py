"""Colours of directions on the faces of a cube: the kernels against the twin.

That the twin is linear between points, without seams, is held by the tests of ``sky``.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cube_map_checks import SIZES, compare, values, wide
from kernel_checks import assert_same_on_threads, leaves
from torch import Tensor

from gsdmsr_cli.ops.cube_map import directions, show_behind, show_behind_twin
from gsdmsr_cli.scene.camera import Camera


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (33, 19), (64, 48)])
def test_kernels_match_the_twin(size: int, width: int, height: int) -> None:
    compare(size, width, height)


def test_twin_passes_gradcheck() -> None:
    (start, points), camera = values(3, 5, 4), wide(5, 4)
    own = leaves(start, torch.float64)
    assert torch.autograd.gradcheck(lambda *g: show_behind_twin(*g, points, camera), own)


def test_diagonals_of_the_cube_have_the_colours_of_its_corners_and_edges() -> None:
    """Pixels whose direction belongs to two or three faces alike."""
    camera = Camera(np.eye(4), 1.0, 1.0, 1.5, 1.5, 3, 3)
    assert (directions(camera).abs() == 1).all(dim=2).sum() == 4
    (_, _, colours), points = values(4, 3, 3)
    nothing = torch.zeros(3, 3, 3), torch.zeros(3, 3)
    found = show_behind(*nothing, colours, points, camera)
    truth = show_behind_twin(*(t.double() for t in (*nothing, colours)), points, camera)
    torch.testing.assert_close(found.double(), truth, rtol=0, atol=1e-6)


@pytest.mark.parametrize("size", SIZES)
def test_results_do_not_depend_on_the_number_of_threads(size: int) -> None:
    start, points = values(size, 64, 48)

    def compute() -> list[Tensor]:
        own = leaves(start, torch.float32)
        found = show_behind(*own, points, wide(64, 48))
        found.square().sum().backward()
        return [found, *(t.grad for t in own if t.grad is not None)]

    assert len(compute()) == 4
    assert_same_on_threads(compute)
