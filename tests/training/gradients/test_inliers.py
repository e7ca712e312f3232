"""Areas that do not fit the other views are left out, details are not."""

from __future__ import annotations

from pathlib import Path

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.training.gradients.inliers import PATCH, STRIDE, inliers

HEIGHT, WIDTH = 70, 101


def pictures(seed: int = 0) -> tuple[Tensor, Tensor]:
    """A target, and a picture that differs from it by a little noise."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.randint(0, 200, (3, HEIGHT, WIDTH), generator=generator, dtype=torch.uint8)
    drawn = target.permute(1, 2, 0) / 255
    return drawn + 0.02 * torch.rand(HEIGHT, WIDTH, 3, generator=generator), target


def by_definition(rgb: Tensor, target: Tensor, share: float) -> Tensor:
    """The same, pixel after pixel; errors that are all but equal are to be ordered alike."""
    errors = (rgb - target.permute(1, 2, 0).float() / 255).abs().mean(dim=2)
    ordered = errors.flatten().sort().values
    fits = errors <= ordered[max(1, round(share * errors.numel())) - 1]
    found = fits.clone()
    for row in range(HEIGHT):
        for column in range(WIDTH):
            near = fits[max(0, row - 1) : row + 2, max(0, column - 1) : column + 2]
            if near.double().mean() > 0.5:
                found[row, column] = True
    for top in range(-STRIDE, HEIGHT, STRIDE):
        for left in range(-STRIDE, WIDTH, STRIDE):
            inside = slice(max(0, top), top + PATCH), slice(max(0, left), left + PATCH)
            if fits[inside].numel() and fits[inside].double().mean() > 0.5:
                found[inside] = True
    return found


def test_an_area_is_left_out() -> None:
    rgb, target = pictures()
    rgb[16:56, 24:64] += 0.5
    found = inliers(rgb, target, 0.7)
    assert not found[24:48, 32:56].any()
    assert found[:, 80:].all() and found[:8].all()


def test_lines_and_single_pixels_are_not() -> None:
    rgb, target = pictures()
    rgb[30] += 0.5
    rgb[:, 50] += 0.5
    rgb[10, 10] += 0.5
    assert inliers(rgb, target, 0.9).all()


def test_nothing_is_left_out_of_all() -> None:
    rgb, target = pictures()
    rgb[16:56, 24:64] += 0.5
    assert inliers(rgb, target, 1.0).all()


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.2, 1.0), st.floats(0.0, 1.0))
def test_it_is_as_defined(seed: int, share: float, error: float) -> None:
    rgb, target = pictures(seed)
    generator = torch.Generator().manual_seed(seed)
    top, left = (int(torch.randint(side - 20, (), generator=generator)) for side in (70, 101))
    rgb[top : top + 40, left : left + 40] += error
    assert torch.equal(inliers(rgb, target, share), by_definition(rgb, target, share))


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, "losses.inliers=0.8")
