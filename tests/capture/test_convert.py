"""A published data set becomes a scene folder that is read back as the same scene."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from datasets import noise, pose, write_dnerf, write_json, write_picture
from neural3d_videos import CAMERAS, FRAMES, write_n3v
from test_prepare import prepare

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.imaging import read_image


def test_a_dnerf_data_set_is_the_same_scene_afterwards(tmp_path: Path) -> None:
    data = write_dnerf(tmp_path / "data", train=3, val=1, test=2)
    ended = prepare(data, "--out", tmp_path / "scene")
    assert ended.returncode == 0, ended.stderr
    before, after = read_scene(data), read_scene(tmp_path / "scene")
    assert after.bound == before.bound and after.duration is None
    for old, new in zip(before.views, after.views, strict=True):
        assert (new.split, new.time) == (old.split, old.time)
        assert new.name == f"{old.split}_{old.name}"
        one, other = old.camera, new.camera
        np.testing.assert_allclose(other.world_to_camera, one.world_to_camera, atol=1e-12)
        assert (one.fx, one.fy, one.cx, one.cy) == (other.fx, other.fy, other.cx, other.cy)
        assert new.image_path.read_bytes() == old.image_path.read_bytes()
    note = json.loads((tmp_path / "scene" / "scene.json").read_text())
    assert note["input"]["kind"] == "dnerf" and note["quality"] is None
    assert not list(tmp_path.glob("*.stages"))


def test_pictures_through_a_lens_are_undistorted(tmp_path: Path) -> None:
    frames = []
    for i in range(4):
        write_picture(tmp_path / "data" / f"p{i}.png", noise(48, 64, 3, seed=i))
        matrix = pose(azimuth=0.2 * i)
        frames.append({"file_path": f"p{i}.png", "transform_matrix": matrix, "time": i / 3})
    lens = {"fl_x": 60.0, "fl_y": 60.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "k1": -0.1}
    write_json(tmp_path / "data" / "transforms.json", {**lens, "frames": frames})
    ended = prepare(tmp_path / "data", "--out", tmp_path / "scene")
    assert ended.returncode == 0, ended.stderr
    before, after = read_scene(tmp_path / "data"), read_scene(tmp_path / "scene")
    assert all(view.lens is None for view in after.views)
    for old, new in zip(before.views, after.views, strict=True):
        assert new.camera.fx == old.camera.fx and old.lens is not None
        undistorted = read_image(new.image_path)
        assert undistorted.shape == (48, 64, 3)
    assert after.bound == before.bound


@pytest.mark.parametrize("keep", [(), ("--keep-stages",)])
def test_videos_of_a_data_set_are_decoded_below_out_and_nowhere_else(
    tmp_path: Path, keep: tuple[str, ...]
) -> None:
    data = write_n3v(tmp_path / "n3v")
    given = set(data.rglob("*"))
    ended = prepare(data, "--out", tmp_path / "scene", *keep)
    assert ended.returncode == 0, ended.stderr
    assert set(data.rglob("*")) == given
    stages = tmp_path / "scene.stages"
    assert stages.is_dir() == bool(keep) == bool(list(stages.glob("decoded-*/cam02/images")))
    before, after = read_scene(data), read_scene(tmp_path / "scene")
    assert len(after.views) == len(before.views) == CAMERAS * FRAMES
    for old, new in zip(before.views, after.views, strict=True):
        assert (new.split, new.time) == (old.split, old.time)
        assert new.image_path.read_bytes() == old.image_path.read_bytes()


def test_masks_for_known_cameras_are_refused(tmp_path: Path) -> None:
    data = write_dnerf(tmp_path / "data")
    ended = prepare(data, "--out", tmp_path / "scene", "--auto-mask")
    assert ended.returncode == 2 and "masks do nothing" in ended.stderr
