"""The capture of a room that devices are measured on shows what it says, where it says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from moving_room import SEEN, SIZE, THINGS, on_path, seen_points, write_capture, write_rig
from walking_capture import Capture, pixel_errors

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.around import cameras_stand_around
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.native import cv2


def pixels(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the columns and rows (P, 2) of the pixels that points are seen in."""
    x, y, z = camera.rotation @ points.T + camera.translation[:, None]
    shown = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    return np.floor(shown).astype(int)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Capture]:
    folder = tmp_path_factory.mktemp("room")
    return folder, write_capture(folder, 96, 16, 1.0, 0.2, 0)


@pytest.mark.parametrize("name", THINGS)
def test_surfaces_are_seen_where_they_are(room: tuple[Path, Capture], name: str) -> None:
    view = read_scene(room[0]).split("test")[1]
    sharp, true = cv2.imread(str(view.signals["moving"]))[..., 0], on_path(view.time, 96)
    assert not np.allclose(view.camera.world_to_camera, true.world_to_camera, atol=0.1)
    points = THINGS[name].at(seen_points(THINGS[name], view.time, 300), view.time)
    columns, rows = pixels(view.camera, points).T
    inside = (columns >= 0) & (columns < 96) & (rows >= 0) & (rows < 72)
    assert inside.sum() > 50
    near = cv2.dilate(sharp, np.ones((3, 3), np.uint8))  # a pixel counts that a ray has met
    assert (near[rows[inside], columns[inside]] == 255).all() and (sharp == 255).mean() < 0.3


def test_points_of_a_surface_keep_their_colours(room: tuple[Path, Capture]) -> None:
    """Of the box, in test pictures: these are sharp and in mean colours."""
    box = THINGS["box"]
    points = seen_points(box, 0.5, 400)
    seen = []
    for view in read_scene(room[0]).split("test"):
        picture = cv2.GaussianBlur(cv2.imread(str(view.image_path)).astype(float), (0, 0), 0.7)
        columns, rows = pixels(view.camera, box.at(points, view.time)).T
        seen.append(picture[rows.clip(0, 71), columns.clip(0, 95)])
    front = np.isclose(points[:, 1], -1)  # towards all of the path
    apart = abs(np.array(seen)[:, front] - np.mean(np.array(seen)[:, front], axis=0)).mean()
    assert front.sum() > 50 and apart < 8


def test_errors_are_as_large_as_asked_for(room: tuple[Path, Capture]) -> None:
    folder, capture = room
    assert np.sqrt(np.square(pixel_errors(capture.given, capture)).mean()) == pytest.approx(
        1, rel=0.02
    )
    assert pixel_errors(capture.cameras, capture).max() < 1e-6
    assert 0.1 < abs(capture.exposures - 1).max() < 0.25 and capture.points is SEEN
    counts = {split: len(read_scene(folder).split(split)) for split in ("train", "val", "test")}
    assert counts == {"train": 14, "val": 2, "test": 4}
    assert json.loads((folder / "scene.json").read_text())["bound"] == 3.0


@pytest.mark.parametrize("around", [False, True])
def test_a_rig_sees_what_moves_from_within_the_room(tmp_path: Path, around: bool) -> None:
    """One camera of the ring stands so near that both things are beside its picture."""
    write_rig(tmp_path, 32, 2, around)
    scene = read_scene(tmp_path)
    assert len(scene.split("train")) == 32 and len(scene.split("test")) == 6
    assert cameras_stand_around(scene) is around
    assert len({view.camera.centre.tobytes() for view in scene.views}) == 19
    assert all((abs(view.camera.centre) < SIZE).all() for view in scene.views)
    masks = [cv2.imread(str(view.signals["moving"]))[..., 0] for view in scene.views]
    shares = np.array([(moving == 255).mean() for moving in masks])
    assert (shares > 0).sum() == len(scene.views) - 2 * around and shares.max() < 0.5
