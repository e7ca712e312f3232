"""Masks that are given and that are found, and what they save when something large moves."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import room
from test_prepare import prepare

from gsdmsr_cli.capture.features import Features
from gsdmsr_cli.capture.frames import read_frames, write_frames
from gsdmsr_cli.capture.masks import read_mask, standing, write_given_masks
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import read_image

FRAMES = 14


def silent(done: int, total: int) -> None:
    assert 0 <= done <= total


def write_masks(folder: Path, moving: np.ndarray, name: str = "shot{:03d}.png") -> Path:
    folder.mkdir()
    for i, mask in enumerate(moving):
        cv2.imwrite(str(folder / name.format(i)), np.where(mask, 255, 0).astype(np.uint8))
    return folder


def error_of(scene: Path, shots: room.Shots) -> float:
    views = read_scene(scene).views
    centres = np.stack([view.camera.centre for view in views])
    return room.trajectory_error(centres, shots.poses[[int(v.name) for v in views], :3, 3])


def quality_of(scene: Path) -> dict:
    return json.loads((scene / "scene.json").read_text())["quality"]


def test_masks_save_the_cameras_from_a_large_thing_that_moves_with_them(tmp_path: Path) -> None:
    shots = room.film(room.walk(FRAMES), thing=0.6)
    assert shots.moving.mean() == pytest.approx(0.36, abs=0.01)
    pictures = room.write_pictures(tmp_path / "pictures", shots)
    ended = prepare(pictures, "--out", tmp_path / "without")
    assert ended.returncode == 3 and "--masks" in ended.stderr
    masks = write_masks(tmp_path / "masks", shots.moving)
    ended = prepare(pictures, "--out", tmp_path / "scene", "--masks", masks)
    assert ended.returncode == 0, ended.stderr
    assert error_of(tmp_path / "scene", shots) < 0.003
    quality = quality_of(tmp_path / "scene")
    assert quality["frames"]["registered"] == FRAMES and quality["warnings"] == []
    assert quality["masks"]["covered"] == pytest.approx(shots.moving.mean(), abs=0.01)
    for view in read_scene(tmp_path / "scene").views:
        shown = read_image(view.signals["moving"])[..., 0] >= 128
        camera = view.camera
        assert shown.shape == (camera.height, camera.width)
        assert (shown == shots.moving[int(view.name)]).mean() > 0.98  # undistortion moves edges


@pytest.fixture(scope="module")
def swaying(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, room.Shots]:
    shots = room.film(room.walk(20), thing=0.3)
    return room.write_pictures(tmp_path_factory.mktemp("swaying") / "pictures", shots), shots


def test_without_masks_there_is_a_warning(swaying: tuple[Path, room.Shots], tmp_path: Path) -> None:
    pictures, _ = swaying
    ended = prepare(pictures, "--out", tmp_path / "scene")
    assert ended.returncode == 0, ended.stderr
    (warning,) = quality_of(tmp_path / "scene")["warnings"]
    assert "moves" in warning and "--masks" in warning and warning in ended.stdout


def test_masks_that_are_found_save_the_cameras_as_well(
    swaying: tuple[Path, room.Shots], tmp_path: Path
) -> None:
    pictures, shots = swaying
    ended = prepare(pictures, "--out", tmp_path / "scene", "--auto-mask", "--json")
    assert ended.returncode == 0, ended.stderr
    seconds = json.loads(ended.stdout)["seconds"]
    assert {"finding cameras", "finding cameras again", "finding what moves"} <= seconds.keys()
    assert seconds["finding cameras again"] > 0 and seconds["other"] < 0.2 * sum(seconds.values())
    assert error_of(tmp_path / "scene", shots) < 0.003
    shared = united = 0
    for view in read_scene(tmp_path / "scene").views:
        shown = read_image(view.signals["moving"])[..., 0] >= 128
        moving = shots.moving[int(view.name)]
        shared += (shown & moving).sum()
        united += (shown | moving).sum()
    assert shared / united > 0.5  # single frames may fare worse


def frames_of(folder: Path, count: int, size: tuple[int, int] = (64, 48), max_side: int = 1600):
    rng = np.random.default_rng(0)
    (folder / "in").mkdir()
    for i in range(count):
        pixels = rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
        cv2.imwrite(str(folder / "in" / f"shot{i:03d}.jpg"), pixels)
    source = find_source(folder / "in")
    (folder / "frames").mkdir()
    write_frames(folder / "frames", source, 60, max_side, silent)
    (folder / "out").mkdir()
    return source, read_frames(folder / "frames")


@pytest.mark.parametrize("name", ["shot{:03d}.png", "shot{:03d}.jpg.png"])
@pytest.mark.parametrize("inverted", [False, True])
def test_masks_are_found_by_name(tmp_path: Path, name: str, inverted: bool) -> None:
    source, frames = frames_of(tmp_path, 9, max_side=32)
    moving = np.zeros((8, 48, 64), bool)
    moving[:, :24, :32] = True
    masks = write_masks(tmp_path / "masks", ~moving if inverted else moving, name)
    write_given_masks(tmp_path / "out", masks, inverted, source, frames, silent)
    for i, frame in enumerate(frames.names):
        expected = np.zeros((24, 32), bool)
        expected[:12, :16] = i < 8
        np.testing.assert_array_equal(read_mask(tmp_path / "out" / frame), expected)
    note = json.loads((tmp_path / "out" / "masks.json").read_text())
    assert note["missing"] == ["shot008.jpg"]


def test_masks_of_another_size_are_refused(tmp_path: Path) -> None:
    source, frames = frames_of(tmp_path, 8)
    masks = write_masks(tmp_path / "masks", np.zeros((8, 50, 64), bool))
    with pytest.raises(DataError, match=r"shot000\.png is 64 x 50 px; .*, 64 x 48"):
        write_given_masks(tmp_path / "out", masks, False, source, frames, silent)


def test_masks_that_cannot_be_read_or_found_are_refused(tmp_path: Path) -> None:
    source, frames = frames_of(tmp_path, 8)
    masks = write_masks(tmp_path / "masks", np.zeros((8, 48, 64), bool))
    (masks / "shot003.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"shot003\.png is damaged or not a picture"):
        write_given_masks(tmp_path / "out", masks, False, source, frames, silent)
    other = write_masks(tmp_path / "other", np.zeros((8, 48, 64), bool), "mask_of_{}.png")
    with pytest.raises(DataError, match=r"shot000\.jpg would be shot000\.png"):
        write_given_masks(tmp_path / "out", other, False, source, frames, silent)
    ended = prepare(tmp_path / "in", "--out", tmp_path / "scene", "--masks", tmp_path / "none")
    assert ended.returncode == 3 and "--masks takes a folder" in ended.stderr
    assert not (tmp_path / "scene").exists()


def test_features_at_the_edge_of_what_moves_are_left_out() -> None:
    moving = np.zeros((100, 200), bool)
    moving[40:60, 80:120] = True
    places = np.array([[10, 10], [100, 50], [78.5, 50], [70, 50], [199.9, 99.9]], np.float32)
    descriptors = np.arange(5 * 128, dtype=np.uint8).reshape(5, 128)
    left = standing(Features(places, descriptors), moving)
    np.testing.assert_array_equal(left.pixels, places[[0, 3, 4]])
    np.testing.assert_array_equal(left.descriptors, descriptors[[0, 3, 4]])
