"""Points on what moves, against balls whose pictures are known in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from balls import BOUND, ORANGE, WHITE, Album, Ball, cameras, photograph, scene_of
from kernel_checks import generator

from gsdmsr_cli.options.preset import SplatOptions
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.starting.changing import CANDIDATES, sample_points
from gsdmsr_cli.training.starting.initial import initial_splats

SIZE, CAMERAS, MOMENTS = 100, 8, 6

SPACING = 2 * BOUND / CANDIDATES ** (1 / 3)

BLUE = (10, 10, 220)


def ball_at(moment: int) -> Ball:
    """Return a ball that goes round the orange one and comes to no place twice."""
    angle = 2 * np.pi * moment / MOMENTS
    return (0.9 * np.cos(angle), 0.9 * np.sin(angle), 0.8), 0.2, BLUE


def rig(standing: list[Ball], moving: bool = True, count: int = CAMERAS) -> tuple[Scene, Pictures]:
    """Return what cameras that stand still see of balls that do, and of one that does not."""
    shots = cameras(count, SIZE)
    views, pictures = [], []
    for moment in range(MOMENTS):
        balls = [*standing, ball_at(moment)] if moving else standing
        for shot in shots:
            time = moment / (MOMENTS - 1)
            views.append(View(str(len(views)), shot, time, "train", Path(str(len(views)))))
            pictures.append(photograph(shot, balls, (0.4, 0.6, 0.4)))
    return replace(scene_of(shots), views=tuple(views)), Album(pictures)


def test_points_lie_where_the_ball_is_at_their_times_in_its_colour() -> None:
    points = sample_points(*rig([]), 400, generator(0))
    assert points.means.shape == points.colours.shape == (400, 3)
    assert set((points.times * (MOMENTS - 1)).round().int().tolist()) == set(range(MOMENTS))
    centres = torch.tensor([ball_at(m)[0] for m in range(MOMENTS)])
    at = (points.times * (MOMENTS - 1)).round().long()
    away = (points.means - centres[at]).norm(dim=1)
    # eight silhouettes meet in little more than the ball, and points spread about the candidates
    assert (away < 0.2 + 2 * SPACING).float().mean() > 0.9
    assert (points.colours - torch.tensor(BLUE) / 255).abs().max() < 0.02


def test_what_stands_has_none() -> None:
    """The orange ball is as far from the background's colour as the blue one is."""
    points = sample_points(*rig([ORANGE]), 400, generator(0))
    away = (points.means - torch.tensor(ORANGE[0])).norm(dim=1)
    assert len(points.means) == 400 and (away > ORANGE[1] - SPACING).all()


def test_without_motion_there_are_none() -> None:
    points = sample_points(*rig([ORANGE], moving=False), 400, generator(0))
    assert points.means.shape == points.colours.shape == (0, 3) and points.times.shape == (0,)


def test_a_camera_that_moves_tells_nothing() -> None:
    scene, pictures = rig([])
    shots = cameras(len(scene.views), SIZE)
    moved = [replace(view, camera=shot) for view, shot in zip(scene.views, shots, strict=True)]
    points = sample_points(replace(scene, views=tuple(moved)), pictures, 400, generator(0))
    assert points.means.shape == (0, 3)


def test_two_cameras_are_too_few() -> None:
    assert len(sample_points(*rig([], count=2), 400, generator(0)).means) == 0


def test_the_share_of_the_first_splats_that_begins_there() -> None:
    scene, pictures = rig([ORANGE])
    options = SplatOptions(count=300, start="box", moving_share=0.4)
    given = pictures, torch.tensor(WHITE), generator(0), 1000
    splats, times = initial_splats(scene, options, *given)
    assert len(splats) == 300 and (~times.isnan()).sum() == 120
    still, pictures = rig([ORANGE], moving=False)
    splats, times = initial_splats(still, options, pictures, *given[1:])
    assert len(splats) == 300 and times.isnan().all()


def test_all_of_the_first_splats_may_begin_there() -> None:
    scene, pictures = rig([ORANGE])
    options = SplatOptions(count=300, start="silhouettes", moving_share=1.0)
    splats, times = initial_splats(
        scene, options, pictures, torch.tensor(WHITE), generator(0), 1000
    )
    assert len(splats) == 300 and not times.isnan().any()
