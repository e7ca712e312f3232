"""Which preset suits a scene follows from its format, or from its cameras."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import write_dnerf, write_json

from gsdmsr_cli.formats import read_scene, suited_preset
from gsdmsr_cli.options.preset_files import preset_names
from gsdmsr_cli.scene.camera import look_at
from gsdmsr_cli.scene.scene import Scene, View


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A scene in D-NeRF's layout."""
    return read_scene(write_dnerf(tmp_path / "scene"))


def filmed(scene: Scene, *shots: tuple[float, float], layout: str = "nerfstudio") -> Scene:
    """The scene as if each of its views was at the x and the time of a shot."""
    view, up = scene.views[0], np.array([0.0, 0.0, 1.0])

    def at(x: float, time: float) -> View:
        pose = look_at(np.array([x, 4.0, 1.0]), np.zeros(3), up)
        camera = replace(view.camera, world_to_camera=pose)
        return replace(view, camera=camera, time=time)

    return replace(scene, layout=layout, views=tuple(at(x, time) for x, time in shots))


def test_a_format_may_name_the_preset_of_its_scenes(scene: Scene) -> None:
    suited = suited_preset(scene)
    assert (suited.name, suited.reason) == ("dnerf", "the data has the layout dnerf")
    assert suited_preset(replace(scene, layout="nerfies")).name == "nerfies"


@pytest.mark.parametrize(
    ("shots", "preset", "reason"),
    [
        ([(0.1 * i, i / 9) for i in range(10)], "video", "one camera moves"),
        ([(0.0, i / 9) for i in range(10)], "video", "one camera has filmed all of it"),
        ([(0.0, 0.0), (0.1, 0.5), (0.1, 1.0)], "video", "one camera moves"),
        ([(x, t) for x in (0, 1) for t in (0, 0.5, 1)], "n3v", "2 cameras that stand still"),
        # clocks of their own: no two views are of one moment
        ([(x, t + 0.1 * x) for x in (0, 1) for t in (0, 0.4, 0.8)], "n3v", "2 cameras that stand"),
        # three cameras that move, and a pair of cameras that moves
        ([(x + t, t) for x in (0, 3, 6) for t in (0, 0.5, 1)], "n3v", "3 cameras see each moment"),
        ([(x + t, t) for x in (0, 3) for t in (0, 0.5, 1)], "video", "one camera moves"),
        # one moment from all around: nothing moves
        ([(0.1 * i, 0.0) for i in range(10)], "video", "one camera moves"),
    ],
)
@pytest.mark.parametrize("layout", ["nerfstudio", "colmap", "neural3d", "panoptic"])
def test_elsewhere_the_cameras_say_it(
    scene: Scene, shots: list[tuple[float, float]], preset: str, reason: str, layout: str
) -> None:
    suited = suited_preset(filmed(scene, *shots, layout=layout))
    assert suited.name == preset and reason in suited.reason
    assert suited.name in preset_names()


@pytest.mark.parametrize(
    ("note", "preset"),
    [
        ({"gsdmsr": 1, "bound": 2.0, "input": {"kind": "dnerf"}}, "dnerf"),
        ({"gsdmsr": 1, "bound": 2.0, "input": {"kind": "video"}}, "video"),
        ({"gsdmsr": 1, "bound": 2.0, "input": {"kind": "no such layout"}}, "video"),
        ({"gsdmsr": 1, "bound": 2.0, "input": {"kind": ["dnerf"]}}, "video"),
        ({"gsdmsr": 1, "bound": 2.0, "input": "dnerf"}, "video"),
        ({"input": {"kind": "dnerf"}}, "video"),  # another tool's
    ],
)
def test_a_converted_scene_counts_as_what_it_was(
    tmp_path: Path, note: dict[str, Any], preset: str
) -> None:
    folder = write_dnerf(tmp_path / "scene")
    frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
    for frame in frames:
        frame["file_path"] += ".png"
    for path in folder.glob("transforms_*.json"):
        path.unlink()
    write_json(folder / "transforms.json", {"camera_angle_x": 0.7, "frames": frames})
    write_json(folder / "scene.json", note)
    scene = read_scene(folder)
    assert scene.layout == "nerfstudio"
    assert suited_preset(scene).name == preset
