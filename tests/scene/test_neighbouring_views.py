"""Which views are neighbours: of the same camera, moment after moment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from view_checks import camera_at, views_of

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.neighbours import neighbours
from gsdmsr_cli.scene.scene import View


def test_neighbours_are_of_the_moments_beside_by_the_same_camera(tmp_path: Path) -> None:
    views = views_of([camera_at(4, 0), camera_at(0, 4)], [0.0, 0.5, 1.0], tmp_path)
    found = {view.name: [v.name for v in beside] for view, beside in neighbours(views).items()}
    assert found["0_0"] == ["0_1"] and found["0_1"] == ["0_0", "0_2"] and found["1_2"] == ["1_1"]


def test_a_camera_that_hardly_moves_has_neighbours_and_one_that_jumps_has_none(
    tmp_path: Path, tiny_scene: Path
) -> None:
    angles = np.linspace(0, 1, 40)  # by 1.5 degrees from moment to moment
    walk = [
        View(str(i), camera_at(4 * np.cos(a), 4 * np.sin(a)), i / 39, "train", tmp_path / "0.png")
        for i, a in enumerate(angles)
    ]
    assert [len(beside) for beside in neighbours(walk).values()] == [1, *38 * [2], 1]
    sparse = [replace(view, time=i / 4) for i, view in enumerate(walk[::8])]
    zoomed = [walk[0], replace(walk[1], camera=replace(walk[1].camera, fx=90.0))]
    jumping = read_scene(tiny_scene).split("train")
    for views in (sparse, zoomed, jumping):
        assert not any(neighbours(views).values())


def test_neighbours_of_some_views_are_sought_among_all(tmp_path: Path) -> None:
    views = views_of([camera_at(4, 0), camera_at(0, 4)], [0.0, 0.5, 1.0], tmp_path)
    whole, some = neighbours(views), neighbours(views, views[1:3])
    assert some == {view: whole[view] for view in views[1:3]}
