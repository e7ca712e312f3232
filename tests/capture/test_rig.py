"""Videos of several cameras that stand still, with a common time axis and one pose each."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import room
from hypothesis import given
from hypothesis import strategies as st
from test_prepare import prepare

from gsdmsr_cli.capture.clocks import common_moments
from gsdmsr_cli.capture.rig import parse_offsets, shift
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.scene.imaging import read_image

CAMERAS, FRAMES, FPS = 5, 12, 10.0


def with_a_block(picture: np.ndarray, moment: int) -> np.ndarray:
    """Return the picture with a grey block whose place, and whose brightness, tell the moment."""
    drawn = picture.copy()
    at = 65 + 15 * moment
    drawn[80:160, at : at + 60] = 50 + 15 * moment
    return drawn


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    folder = tmp_path_factory.mktemp("rig") / "videos"
    folder.mkdir()
    poses = room.walk(CAMERAS, reach=0.8)
    for camera, pose in enumerate(poses):
        background = room.draw(pose, 320, 240)[0]
        late = 3 if camera == 2 else 0  # the clock of camera 2 is 0.3 s ahead
        film = [with_a_block(background, i - late) for i in range(FRAMES)]
        shots = room.Shots(np.stack(film), poses, np.zeros(FRAMES))
        room.write_film(folder / f"cam{camera}.mp4", shots, FPS)
    return folder, poses


def test_a_rig_is_found_and_its_clocks_agree(rig: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    folder, poses = rig
    out = tmp_path / "scene"
    ended = prepare(folder, "--out", out, "--rig", "--offset", "cam2=0.3", "--frames", "8")
    assert ended.returncode == 0, ended.stderr
    scene = read_scene(out)
    assert scene.duration == pytest.approx((FRAMES - 1 - 3) / FPS)
    names = {f"cam{c}_{k:05d}" for c in range(CAMERAS) for k in range(8)}
    assert len(scene.views) == len(names) == 40
    assert {view.split for view in scene.views[:8]} == {"test"}
    assert all(view.split == "train" for view in scene.views[8:])
    centres = np.stack([view.camera.centre for view in scene.views[::8]])
    assert room.trajectory_error(centres, poses[:, :3, 3]) < 0.01
    for i, view in enumerate(scene.views):
        assert view.time == pytest.approx((i % 8) / 7)
    # all cameras show the same moment: the block's brightness tells it
    for k in (0, 4, 7):
        shades = []
        for view in scene.views[k::8]:
            row = read_image(view.image_path)[120]
            flat = np.abs(np.diff(row.astype(int), axis=0)).max(axis=1) < 4
            runs = np.split(row[1:], np.flatnonzero(~flat))
            shades.append(float(np.median(max(runs, key=len))))
        assert np.ptp(shades) < 5, (k, shades)
    note = json.loads((out / "scene.json").read_text())
    assert note["input"]["kind"] == "rig" and note["options"]["offsets"] == {"cam2": 0.3}


def test_a_camera_that_moves_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "videos"
    folder.mkdir()
    shots = room.film(room.walk(10), 160, 120)
    still = room.Shots(np.stack([shots.pictures[5]] * 10), shots.poses, shots.moving)
    for name, film in (("a", still), ("b", shots), ("c", still)):
        room.write_film(folder / f"{name}.mp4", film)
    ended = prepare(folder, "--out", tmp_path / "scene", "--rig")
    assert ended.returncode == 3 and "b.mp4: this camera moves" in ended.stderr
    (folder / "c.mp4").unlink()
    ended = prepare(folder, "--out", tmp_path / "scene", "--rig")
    assert ended.returncode == 3 and "2 videos; a rig has at least 3 cameras" in ended.stderr
    assert not (tmp_path / "scene").exists()


@given(
    st.lists(st.tuples(st.floats(-2, 2), st.integers(20, 60)), min_size=3, max_size=5),
    st.integers(2, 30),
)
def test_moments_lie_where_all_cameras_film(cameras: list[tuple[float, int]], count: int) -> None:
    clocks = [start + np.arange(frames) / 5 for start, frames in cameras]
    first, last = max(c[0] for c in clocks), min(c[-1] for c in clocks)
    if last <= first + 0.3:
        return
    moments = common_moments(clocks, count, Path("x"))
    assert moments[0] == first and moments[-1] == pytest.approx(last)
    assert 2 <= len(moments) <= count


def test_films_that_do_not_overlap_are_refused() -> None:
    clocks = [np.arange(10) / 10, np.arange(10) / 10 + 3]
    with pytest.raises(DataError, match="do not film at the same time; check --offset"):
        common_moments(clocks, 5, Path("x"))


def test_offsets_are_seconds_by_camera() -> None:
    assert parse_offsets(["left=0.25", "a=b=-1"]) == {"left": 0.25, "a=b": -1.0}
    for text in ("left", "=2", "left=soon", "left=nan"):
        with pytest.raises(UsageError, match="CAMERA=SECONDS"):
            parse_offsets([text])


def test_shift_is_that_of_most_features() -> None:
    picture = room.draw(room.walk(3)[1], 320, 240)[0]
    moved = np.roll(picture, 6, axis=1)
    assert shift(picture, moved) == pytest.approx(6, abs=0.3)
    assert shift(picture, picture) == 0 == shift(np.zeros_like(picture), picture)
