"""Tests of what tells whether cameras stand around the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kernel_checks import generator
from rigs import cameras_of

from gsdmsr_cli.demo.synthetic import camera_on_dome
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.options.preset import SplatOptions, load_preset
from gsdmsr_cli.scene.around import cameras_stand_around
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.starting.initial import initial_splats


def rig(cameras: Sequence[Camera], moments: int = 3) -> Scene:
    """A scene that all cameras see at all moments, and another camera, behind them all, in val."""
    times = [moment / 2 for moment in range(moments)]
    views = [
        View(f"{i}", camera, time, "train", Path())
        for time in times
        for i, camera in enumerate(cameras)
    ]
    views.append(View("v", facing(1.0, 0.0, turned=math.pi), 0.0, "val", Path()))
    points = np.zeros((0, 3), np.float32)
    return Scene(Path(), "test", tuple(views), points, None, None, 1.5, "")


def facing(x: float, z: float, turned: float = 0.0) -> Camera:
    """A camera of a panel, which looks along y, or turned about the vertical axis [rad]."""
    centre = np.array([x, -3.0, z])
    ahead = centre + np.array([math.sin(turned), math.cos(turned), 0.0])
    return Camera(look_at(centre, ahead, np.array([0.0, 0.0, 1.0])), 90.0, 90.0, 48, 40, 96, 80)


PANEL = [facing(x, z) for x in (-1.0, 0.0, 1.0) for z in (-0.5, 0.5)]


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


def test_a_rig_around_starts_in_the_box_where_the_preset_says_so() -> None:
    """From the box no pictures are read, of which there are none here."""
    around = rig([camera_on_dome(angle, 0.6, 32) for angle in (0.0, 1.5, 3.0)])
    options = SplatOptions(start="surfaces", start_around="box", count=50)
    given = Pictures((1.0, 1.0, 1.0), 1, 0), torch.ones(3), generator(0), 100
    splats, times = initial_splats(around, options, *given)
    assert len(splats) == 50 and splats.means.abs().max() <= around.bound and times.isnan().all()
    for other in (rig(PANEL), options), (around, replace(options, start_around=None)):
        with pytest.raises(DataError, match=r"image \. does not exist"):
            initial_splats(*other, *given)


@pytest.mark.parametrize("name", ["n3v", "persistent", "hicom", "3dgstream"])
def test_presets_for_rigs_look_how_cameras_stand(name: str) -> None:
    splats = load_preset(name, None, []).splats
    assert splats.start == "surfaces" and splats.start_around in {"box", "silhouettes"}
