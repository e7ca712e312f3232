"""Which views a moment has, and which captures and options a stream refuses."""

from __future__ import annotations

from pathlib import Path

import pytest
from rigs import write_rig
from stream_checks import preset_of

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.training.streaming.shots import (
    check_options,
    check_scene,
    first_shot,
    shots_of,
    watched,
)


def test_moments_are_in_the_order_of_their_times(tmp_path: Path) -> None:
    scene = read_scene(write_rig(tmp_path, size=8, cameras=3, moments=4, missing=[(2, 0)]))
    views = scene.split("train")
    shots = shots_of(views)
    assert [shot.time for shot in shots] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert [len(shot.rows) for shot in shots] == [3, 3, 2, 3]
    for shot in shots:
        assert {views[row].time for row in shot.rows} == {shot.time}
    assert sorted(row for shot in shots for row in shot.rows) == [*range(len(views))]


def test_a_moment_that_lacks_cameras_is_named(tmp_path: Path) -> None:
    missing = [(1, 0), (3, 0), (3, 2)]
    scene = read_scene(write_rig(tmp_path, size=8, cameras=4, moments=5, missing=missing))
    assert check_scene(scene) == [
        "moment 1 (time 0.25) lacks 1 of 4 cameras; it is learnt from the others",
        "moment 3 (time 0.75) lacks 2 of 4 cameras; it is learnt from the others",
    ]


def test_of_many_moments_that_lack_cameras_the_first_are_named(tmp_path: Path) -> None:
    missing = [(moment, 0) for moment in range(1, 9)]
    scene = read_scene(write_rig(tmp_path, size=8, cameras=3, moments=9, missing=missing[:7]))
    told = check_scene(scene)
    assert len(told) == 6 and told[-1] == "2 more moments lack cameras"


def test_one_camera_is_refused(tiny_scene: Path) -> None:
    with pytest.raises(DataError, match="one camera sees each moment, and --stream needs 2"):
        check_scene(read_scene(tiny_scene))


def test_the_initial_splats_are_looked_for_in_the_first_moment(tmp_path: Path) -> None:
    scene = read_scene(write_rig(tmp_path, size=8, cameras=3, moments=2))
    first = first_shot(scene)
    assert {view.time for view in first.split("train")} == {0.0} and len(first.split("train")) == 3
    assert first.split("val") == scene.split("val")


def test_the_watched_view_is_held_out_where_one_is(tmp_path: Path) -> None:
    scene = read_scene(write_rig(tmp_path / "a", size=8, cameras=3, moments=2))
    for shot in shots_of(scene.split("train")):
        view = watched(scene, shot)
        assert (view.split, view.time) == ("val", shot.time)
    (tmp_path / "a" / "transforms_val.json").unlink()
    scene = read_scene(tmp_path / "a")
    shot = shots_of(scene.split("train"))[1]
    view = watched(scene, shot)
    assert (view.split, view.time) == ("train", shot.time)


@pytest.mark.parametrize(
    ("preset", "options", "message"),
    [
        ("n3v", ["stream.enabled=true"], "motion.name is multiscale, .* has to be one of .*tracks"),
        ("persistent", ["splats.sh_degree=1", "splats.sh_start=0.3"], "splats.sh_start is 0.3"),
        ("persistent", ["saliency.gate=freeze"], "saliency.gate is freeze; allowed"),
    ],
)
def test_options_that_do_not_go_together_are_refused(
    preset: str, options: list[str], message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        check_options(load_preset(preset, None, options))


def test_without_a_stream_any_motion_goes(tmp_path: Path) -> None:
    check_options(load_preset("n3v", None, []))
    check_options(preset_of())


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("steps=0", "1 or more"),
        ("budget=soon", "null or a positive duration"),
        ("extrapolate=1.5", "0 to 1"),
        ("keyframe_every=0", "1 or more"),
        ("place_step=0", "1e-7 to 0.1"),
        ("turn_step=1", "1e-7 to 0.1"),
        ("rigidity=-1", "0 or more"),
        ("samples=0", "1 or more"),
    ],
)
def test_values_out_of_range_are_refused(option: str, message: str) -> None:
    key = option.partition("=")[0]
    with pytest.raises(UsageError, match=rf"stream\.{key} is .*; allowed: {message}"):
        load_preset("persistent", None, [f"stream.{option}"])
