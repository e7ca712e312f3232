"""Tests of what tells whether cameras stand around the scene."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from rigs import cameras_of
from standing import PANEL, facing, rig

from gsdmsr_cli.scene.around import cameras_stand_around


def test_a_dome_stands_around_and_a_panel_does_not() -> None:
    assert cameras_stand_around(rig(cameras_of(8, 32)))
    assert not cameras_stand_around(rig(PANEL))
    assert not cameras_stand_around(rig(PANEL[:1]))


@pytest.mark.parametrize(("apart", "around"), [(89, False), (91, True), (180, True), (271, False)])
def test_a_right_angle_is_what_decides(apart: float, around: bool) -> None:
    cameras = [*PANEL, facing(0.0, 0.0, math.radians(apart))]
    assert cameras_stand_around(rig(cameras)) is around


def test_cameras_of_other_splits_do_not_count() -> None:
    scene = rig(PANEL)
    assert not cameras_stand_around(scene)
    turned = [replace(view, split="train") for view in scene.views]
    assert cameras_stand_around(replace(scene, views=tuple(turned)))
