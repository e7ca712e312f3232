"""What a player is told of the camera that has filmed a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gsdmsr_cli.commands._showing import PLACES, way_of_the_camera
from gsdmsr_cli.formats import read_scene


def test_cameras_that_jump_have_no_way(tiny_scene: Path) -> None:
    assert way_of_the_camera(read_scene(tiny_scene).split("train")) == []


def test_one_camera_has_a_way_in_the_order_of_time(rig: Path) -> None:
    views = read_scene(rig).split("train")
    way = way_of_the_camera(views[::-1])
    assert len(way) == len(views)
    assert [view.time for view in way] == sorted(view.time for view in views)


def test_several_cameras_at_a_moment_have_no_way(rig: Path) -> None:
    views = read_scene(rig).split("train")
    assert way_of_the_camera([*views, replace(views[0], name="beside")]) == []


def test_a_single_view_is_no_way(rig: Path) -> None:
    assert way_of_the_camera(read_scene(rig).split("train")[:1]) == []


def test_of_a_long_way_the_ends_and_places_between_are_kept(rig: Path) -> None:
    view = read_scene(rig).split("train")[0]
    views = [replace(view, time=row / 199, name=str(row)) for row in range(200)]
    way = way_of_the_camera(views)
    assert len(way) == PLACES and (way[0], way[-1]) == (views[0], views[-1])
