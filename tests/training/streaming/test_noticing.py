"""Where the errors of several cameras meet: a ball that is known, hidden or half seen."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gsdmsr_cli.demo.synthetic import camera_on_dome
from gsdmsr_cli.drawing.flow import project
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.streaming.noticing import Look, find_places, look

SIZE = 48
BOX = (-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)
CENTRE, RADIUS = torch.tensor([0.4, -0.2, 0.3]), 0.25
COLOUR = torch.tensor([0.9, 0.2, 0.1])


def cameras_of(count: int) -> list[Camera]:
    return [
        camera_on_dome(2 * math.pi * i / count, 0.3 + 0.4 * (i % 2), SIZE) for i in range(count)
    ]


def seen_by(camera: Camera, there: bool = True) -> Look:
    """Return a view that shows the ball, which is not drawn yet, before a right background."""
    rng = torch.Generator().manual_seed(5)
    inside = CENTRE + 0.8 * RADIUS * torch.nn.functional.normalize(
        torch.randn(3000, 3, generator=rng), dim=1
    )
    errors, true = torch.full((SIZE, SIZE), 0.02), torch.full((SIZE, SIZE, 3), 0.5)
    if there:
        column, row = project(inside, camera).long().unbind(dim=1)
        errors[row, column] = 0.4
        true[row, column] = COLOUR
    return Look(camera, errors, true)


def places_of(looks: list[Look], least: float = 0.15, most: int = 200) -> tuple[Tensor, Tensor]:
    found = find_places(looks, BOX, least, most, torch.Generator().manual_seed(1))
    return found.means, found.colours


def test_places_lie_in_what_is_new_and_have_its_colours() -> None:
    means, colours = places_of([seen_by(camera) for camera in cameras_of(8)])
    assert len(means) == 200
    assert ((means - CENTRE).norm(dim=1) < 1.3 * RADIUS).all()
    assert means.std(dim=0).min() > 0.25 * RADIUS, "all over it"
    torch.testing.assert_close(colours, COLOUR.expand_as(colours))


def test_a_camera_before_which_something_stands_does_not_hide_it() -> None:
    looks = [seen_by(camera, there=i > 0) for i, camera in enumerate(cameras_of(8))]
    means, _ = places_of(looks)
    assert len(means) and ((means - CENTRE).norm(dim=1) < 1.5 * RADIUS).all()


def test_what_one_camera_sees_alone_is_nowhere() -> None:
    means, colours = places_of(
        [seen_by(camera, there=i < 2) for i, camera in enumerate(cameras_of(8))]
    )
    assert means.shape == (0, 3) and colours.shape == (0, 3)


@pytest.mark.parametrize(("least", "count"), [(0.5, 0), (0.3, 200)])
def test_errors_that_are_small_are_nothing_new(least: float, count: int) -> None:
    means, _ = places_of([seen_by(camera) for camera in cameras_of(8)], least)
    assert len(means) == count


def test_two_cameras_are_not_enough() -> None:
    means, _ = places_of([seen_by(camera) for camera in cameras_of(2)])
    assert not len(means)


def test_errors_are_means_of_colours_about_a_pixel_and_masked_ones_are_none() -> None:
    rgb, true = torch.zeros(5, 6, 3), torch.zeros(3, 5, 6, dtype=torch.uint8)
    true[:, 2, 3] = torch.tensor([255, 0, 0], dtype=torch.uint8)
    mask = torch.ones(5, 6, dtype=torch.bool)
    mask[0] = False
    found = look(camera_on_dome(0.0, 0.3, SIZE), rgb, true, mask)
    assert found.errors[0].isnan().all()
    expected = torch.zeros(4, 6)
    expected[0:3, 2:5] = 1 / 27
    torch.testing.assert_close(found.errors[1:], expected)
    assert torch.equal(found.true[2, 3], torch.tensor([1.0, 0.0, 0.0]))
