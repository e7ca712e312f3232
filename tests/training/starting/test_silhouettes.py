"""Points from silhouettes, against spheres whose pictures are known in closed form."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from balls import BLACK, BOUND, ORANGE, WHITE, Album, Ball, cameras, photograph, scene_of
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.starting.sightings import Points
from gsdmsr_cli.training.starting.silhouettes import sample_points


def points_of(
    shots: list[Camera],
    pictures: list[Tensor],
    background: tuple[float, float, float] = WHITE,
    count: int = 500,
    seed: int = 0,
) -> Points:
    colour = torch.tensor(background)
    return sample_points(scene_of(shots), Album(pictures), colour, count, generator(seed))


def distances(points: Points, ball: Ball) -> Tensor:
    """Return how far the points are from the ball's centre, in its radii."""
    return (points.means - torch.tensor(ball[0])).norm(dim=1) / ball[1]


@pytest.mark.parametrize("background", [WHITE, BLACK])
@pytest.mark.parametrize("size", [40, 210])  # the larger one is looked at pixel by other pixel
def test_points_fall_into_a_ball_and_have_its_colour(
    size: int, background: tuple[float, float, float]
) -> None:
    shots = cameras(12, size)
    pictures = [photograph(shot, [ORANGE], background) for shot in shots]
    points = points_of(shots, pictures, background)
    assert points.means.shape == points.colours.shape == (500, 3)
    away = distances(points, ORANGE)
    # the ball is 8 % of the box; twelve silhouettes meet in little more than the ball
    assert (away < 1.1).float().mean() > 0.85
    # all over the ball, not only in its middle: half of its volume lies outside 0.79 radii
    assert 0.4 < (away[away < 1] > 0.5 ** (1 / 3)).float().mean() < 0.6
    expected = torch.tensor(ORANGE[2]) / 255
    torch.testing.assert_close(points.colours[away < 1], expected.expand(int((away < 1).sum()), 3))


def test_each_of_two_balls_keeps_its_colour() -> None:
    """Where one hides the other, or a silhouette is another ball's, colours do mix a little."""
    red: Ball = ((0.0, 0.0, 0.65), 0.5, (220, 10, 10))
    blue: Ball = ((0.0, 0.0, -0.65), 0.5, (10, 10, 220))
    shots = cameras(16, 60)
    points = points_of(shots, [photograph(shot, [red, blue], WHITE) for shot in shots])
    for ball, other in ((red, blue), (blue, red)):
        inside = distances(points, ball) < 1
        assert inside.sum() > 100
        own, others = (torch.tensor(b[2]) / 255 for b in (ball, other))
        colours = points.colours[inside]
        assert ((colours - own).norm(dim=1) < (colours - others).norm(dim=1)).all()


def test_a_single_rectangle_is_a_cone_from_the_camera() -> None:
    """Points project into the pixels that are drawn, though rows and columns differ.

    Half a pixel is what spreading the points around their candidates may add.
    """
    shot = replace(cameras(1, 24)[0], width=30, cx=14.0, fx=26.0)
    picture = torch.full((3, 24, 30), 255, dtype=torch.uint8)
    picture[:, 4:9, 17:26] = 0
    points = points_of([shot], [picture], count=2000)
    at = points.means.double() @ torch.tensor(shot.rotation).T + torch.tensor(shot.translation)
    column = at[:, 0] / at[:, 2] * shot.fx + shot.cx
    row = at[:, 1] / at[:, 2] * shot.fy + shot.cy
    assert (points.colours == 0).all()
    assert ((row > 4 - 0.5) & (row < 9 + 0.5)).all()
    assert ((column > 17 - 0.5) & (column < 26 + 0.5)).all()


def test_cameras_that_do_not_see_a_point_have_no_say() -> None:
    """One faces away, its picture silhouette all over; points behind it are not in that."""
    shots = cameras(8, 40)
    away = shots[0].world_to_camera.copy()
    away[[0, 2]] *= -1  # turned round its y axis
    pictures = [photograph(shot, [ORANGE], WHITE) for shot in shots]
    expected = points_of(shots, pictures)
    blind = replace(shots[0], world_to_camera=away)
    black = torch.zeros(3, 40, 40, dtype=torch.uint8)
    found = points_of([*shots, blind], [*pictures, black])
    assert torch.equal(found.means, expected.means)
    assert torch.equal(found.colours, expected.colours)


@pytest.mark.parametrize("shade", [0, 128, 255])
def test_pictures_without_silhouettes_fill_the_box_evenly(shade: int) -> None:
    """All silhouette, or none at all: then the colour is grey."""
    shots = cameras(10, 16, distance=8.0)  # all see the whole box
    pictures = [torch.full((3, 16, 16), shade, dtype=torch.uint8)] * 10
    points = points_of(shots, pictures, count=4000)
    assert points.means.abs().max() <= BOUND
    assert points.means.mean(dim=0).abs().max() < 0.06
    variances = points.means.var(dim=0)
    torch.testing.assert_close(variances, torch.full((3,), BOUND**2 / 3), atol=0.04, rtol=0)
    colour = 0.5 if shade == 255 else shade / 255
    torch.testing.assert_close(points.colours, torch.full((4000, 3), colour))


@pytest.mark.parametrize("shade", [0, 255])
def test_where_no_view_looks_points_are_as_dense_as_elsewhere(shade: int) -> None:
    """Two cameras that see a part of the box each; what neither sees is grey."""
    shots = [replace(shot, fx=60.0, fy=60.0) for shot in cameras(2, 16)]
    pictures = [torch.full((3, 16, 16), shade, dtype=torch.uint8)] * 2
    points = points_of(shots, pictures, count=4000)

    def seen(means: Tensor) -> Tensor:
        within = torch.zeros(len(means), dtype=torch.bool)
        for shot in shots:
            at = means.double() @ torch.tensor(shot.rotation).T + torch.tensor(shot.translation)
            places = at[:, :2] / at[:, 2:] * 60 + 8
            within |= ((places > 0) & (places < 16)).all(dim=1)
        return within

    anywhere = (2 * torch.rand(40000, 3, generator=generator(1)) - 1) * BOUND
    expected = float(seen(anywhere).float().mean())
    assert 0.05 < expected < 0.5
    assert float(seen(points.means).float().mean()) == pytest.approx(expected, abs=0.03)
    grey = (points.colours == 0.5).all(dim=1)
    assert float(grey.float().mean()) == pytest.approx(1 - expected * (shade == 0), abs=0.03)


def test_the_seed_decides() -> None:
    shots = cameras(4, 16)
    pictures = [photograph(shot, [ORANGE], WHITE) for shot in shots]
    one, same, other = (points_of(shots, pictures, count=40, seed=seed) for seed in (3, 3, 4))
    assert torch.equal(one.means, same.means) and torch.equal(one.colours, same.colours)
    assert not torch.equal(one.means, other.means)
