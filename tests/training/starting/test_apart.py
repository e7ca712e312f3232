"""Whether something lies apart, in pictures of balls that are known in closed form."""

from __future__ import annotations

import math

import pytest
import torch
from balls import BLACK, ORANGE, WHITE, Album, Ball, cameras, photograph, scene_of

from gsdmsr_cli.training.starting.apart import views_with_things_apart

COUNT, SIZE = 16, 100


def share(
    balls: list[list[Ball]], background: tuple[float, float, float] = WHITE, filled: bool = False
) -> float:
    """Return the share of views that show something apart, where each shows balls of its own."""
    shots = cameras(len(balls), SIZE)
    pictures = [photograph(shot, own, background) for shot, own in zip(shots, balls, strict=True)]
    if filled:
        pictures = [torch.zeros_like(picture) for picture in pictures]
    return views_with_things_apart(scene_of(shots), Album(pictures), torch.tensor(background))


def flying(away: float, radius: float) -> list[Ball]:
    """Return a ball that goes round the orange one, at one place for each view."""
    (x, y, z), _, _ = ORANGE
    angles = [0.9 * i for i in range(COUNT)]
    centres = [(x + away * math.cos(a), y + away * math.sin(a), z) for a in angles]
    return [(centre, radius, (10, 10, 220)) for centre in centres]


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_what_stands_lies_nowhere_apart(background: tuple[float, float, float]) -> None:
    assert share([[ORANGE]] * COUNT, background) == 0


@pytest.mark.parametrize("background", [WHITE, BLACK])
def test_a_ball_that_flies_is_apart_wherever_nothing_hides_it(
    background: tuple[float, float, float],
) -> None:
    small = ((0.3, -0.2, 0.1), 0.3, ORANGE[2])
    assert 0.4 < share([[small, ball] for ball in flying(0.9, 0.15)], background) < 1
    assert share([[ball] for ball in flying(0.9, 0.15)], background) == 1


def test_what_is_joined_to_what_stands_is_not_apart() -> None:
    assert share([[ORANGE, ball] for ball in flying(0.8, 0.2)]) == 0


def test_what_a_few_views_show_counts_for_these() -> None:
    small = ((0.3, -0.2, 0.1), 0.3, ORANGE[2])
    balls = [[small, ball] if i < 4 else [small] for i, ball in enumerate(flying(0.9, 0.15))]
    assert 0 < share(balls) <= 4 / COUNT


def test_specks_are_not_things() -> None:
    small = ((0.3, -0.2, 0.1), 0.3, ORANGE[2])
    assert share([[small, ball] for ball in flying(0.9, 0.03)]) == 0


def test_pictures_without_a_plain_background_show_nothing_apart() -> None:
    assert share([[ORANGE]] * COUNT, filled=True) == 0
