"""Files of keyframes: what they may say, and what is said of those that say something else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.paths import make_film
from gsdmsr_cli.scene.film import Film, PathOptions
from gsdmsr_cli.scene.scene import Scene

VIEW = {"view": "test/r_000", "time": 0.25}
OWN = {"position": [3.0, 0.0, 1.0], "look_at": [0.0, 0.0, 0.2], "time": 1.0}


@pytest.fixture(scope="module")
def scene(tiny_scene: Path) -> Scene:
    return read_scene(tiny_scene)


def film_of(scene: Scene, folder: Path, document: Any, **more: Any) -> Film:
    path = folder / "tour.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    frames = more.pop("frames", None)
    return make_film(scene, str(path), PathOptions(frames), **more)


def test_a_film_goes_from_a_view_to_a_place_of_its_own(scene: Scene, tmp_path: Path) -> None:
    film = film_of(scene, tmp_path, {"keyframes": [VIEW, OWN], "frames": 5, "fps": 12})
    assert (film.name, len(film.shots), film.fps) == ("tour", 5, 12)
    assert [shot.time for shot in film.shots] == pytest.approx([0.25, 0.4375, 0.625, 0.8125, 1])
    first, last = film.shots[0].camera, film.shots[-1].camera
    view = scene.split("test")[0].camera
    np.testing.assert_allclose(first.world_to_camera, view.world_to_camera, atol=1e-9)
    np.testing.assert_allclose(last.centre, OWN["position"], atol=1e-9)
    x, y, z = last.rotation @ OWN["look_at"] + last.translation
    assert abs(x) < 1e-9 and abs(y) < 1e-9 and z > 0
    assert last.rotation[1] @ [0, 0, 1] < 0  # y points down
    assert (last.width, last.height, last.cx, last.cy) == (48, 48, 24, 24)


def test_a_field_of_view_is_that_of_the_height(scene: Scene, tmp_path: Path) -> None:
    keys = [VIEW, OWN | {"field_of_view": 90}]
    camera = film_of(scene, tmp_path, {"keyframes": keys}).shots[-1].camera
    assert camera.fx == camera.fy == pytest.approx(24)


def test_an_up_turns_the_camera(scene: Scene, tmp_path: Path) -> None:
    keys = [VIEW, OWN | {"up": [0, 1, 0]}]
    camera = film_of(scene, tmp_path, {"keyframes": keys}).shots[-1].camera
    assert camera.rotation[1] @ [0, 1, 0] == pytest.approx(-1)


def test_seconds_say_how_long_the_film_is_and_where_it_waits(scene: Scene, tmp_path: Path) -> None:
    keys = [VIEW | {"at": 0}, VIEW | {"at": 2, "time": 0.75}, OWN | {"at": 2.5}]
    film = film_of(scene, tmp_path, {"keyframes": keys, "fps": 10})
    assert len(film.shots) == 26
    assert film.shots[20].time == pytest.approx(0.75)
    assert film.shots[10].time == pytest.approx(0.5)
    faster = film_of(scene, tmp_path, {"keyframes": keys, "fps": 10}, fps=20)
    assert (len(faster.shots), faster.fps) == (51, 20)


def test_options_of_the_command_go_before_the_file(scene: Scene, tmp_path: Path) -> None:
    document = {"keyframes": [VIEW, OWN], "frames": 5}
    assert len(film_of(scene, tmp_path, document, frames=7).shots) == 7
    frozen = film_of(scene, tmp_path, document, time=0.5)
    assert {shot.time for shot in frozen.shots} == {0.5}
    assert (film_of(scene, tmp_path, document).fps, len(frozen.shots)) == (30, 5)


BAD = {
    "no JSON": ("{", r"tour\.json: damaged"),
    "no object": ("[]", "holds no JSON object"),
    "nothing": ({}, "key 'keyframes' is missing"),
    "no list": ({"keyframes": 3}, "keyframes is 3; allowed: a list"),
    "one": ({"keyframes": [VIEW]}, "allowed: a list of two or more"),
    "unknown key": ({"keyframes": [VIEW, OWN], "fsp": 3}, "unknown key 'fsp'; did you mean 'fps'"),
    "no frames": ({"keyframes": [VIEW, OWN], "frames": 0}, "frames is 0; allowed: 1 to"),
    "half a frame": ({"keyframes": [VIEW, OWN], "frames": 1.5}, "frames is 1.5; allowed: a whole"),
    "no speed": ({"keyframes": [VIEW, OWN], "fps": 0}, "fps is 0.*allowed: more than 0"),
    "no keyframe": ({"keyframes": [VIEW, 3]}, r"keyframes\[1\] is 3; allowed: an object"),
    "unknown key of one": (
        {"keyframes": [VIEW | {"tmie": 1}, OWN]},
        r"keyframes\[0\]: unknown key 'tmie'; did you mean 'time'\?",
    ),
    "no time": ({"keyframes": [{"view": "test/r_000"}, OWN]}, r"\[0\]: key 'time' is missing"),
    "late": ({"keyframes": [VIEW | {"time": 1.4}, OWN]}, r"\[0\]: time is 1.4; allowed: 0 to 1"),
    "text": ({"keyframes": [VIEW, OWN | {"time": "1"}]}, r'\[1\]: time is "1"; allowed: a number'),
    "NaN": ('{"keyframes": [{"view": "x", "time": NaN}, {}]}', "damaged: NaN is not a number"),
    "no camera": ({"keyframes": [VIEW, {"time": 0}]}, r"\[1\]: position is null; allowed: three"),
    "no target": (
        {"keyframes": [VIEW, {"time": 0, "position": [1, 2, 3]}]},
        r"\[1\]: look_at is null; allowed: three numbers",
    ),
    "two cameras": ({"keyframes": [OWN, VIEW | OWN]}, r"\[1\]: view is .*no 'view' beside"),
    "a plane": ({"keyframes": [VIEW, OWN | {"look_at": [0, 0]}]}, "allowed: a list of 3 items"),
    "nowhere": (
        {"keyframes": [VIEW, OWN | {"look_at": OWN["position"]}]},
        "allowed: another point than 'position'",
    ),
    "up ahead": ({"keyframes": [VIEW, OWN | {"up": [3, 0, 0.8]}]}, r"\[1\]: up is .*line of sight"),
    "no up": ({"keyframes": [VIEW, OWN | {"up": [0, 0, 0]}]}, r"\[1\]: up is .*line of sight"),
    "flat": ({"keyframes": [VIEW, OWN | {"field_of_view": 180}]}, "more than 0, below 180"),
    "no such view": (
        {"keyframes": [VIEW, {"view": "test/r_00", "time": 0}]},
        r"\[1\]: view: no view is called 'test/r_00'; did you mean 'test/r_00",
    ),
    "which view": (
        {"keyframes": [VIEW, {"view": "r_000", "time": 0}]},
        r"\[1\]: view: several views are called 'r_000'; write .*train/r_000",
    ),
    "some seconds": ({"keyframes": [VIEW | {"at": 0}, OWN]}, r"\[1\]: key 'at' is missing"),
    "late begin": ({"keyframes": [VIEW | {"at": 1}, OWN | {"at": 2}]}, r"at is 1; allowed: 0"),
    "backwards": (
        {"keyframes": [VIEW | {"at": 0}, OWN | {"at": 0}]},
        r"\[1\]: at is 0; allowed: more than the one before, 0",
    ),
    "endless": ({"keyframes": [VIEW | {"at": 0}, OWN | {"at": 1e6}]}, "allowed: up to 100000"),
}  # fmt: skip


@pytest.mark.parametrize(("document", "message"), BAD.values(), ids=BAD)
def test_what_a_file_may_not_say_is_told_in_one_line(
    scene: Scene, tmp_path: Path, document: Any, message: str
) -> None:
    with pytest.raises(DataError, match=message) as caught:
        film_of(scene, tmp_path, document)
    assert str(tmp_path / "tour.json") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_named(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.json: cannot be read"):
        make_film(scene, str(tmp_path / "none.json"), PathOptions())
