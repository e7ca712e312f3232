"""Cameras of a rig that have lost frames, stopped early or cannot be read are named."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import room
from hypothesis import given
from hypothesis import strategies as st
from videos import TICKS, write_video

from gsdmsr_cli.capture.clocks import NEAR, common_moments, doubts_about, frames_at
from gsdmsr_cli.capture.frames import read_frames
from gsdmsr_cli.capture.rig import read_rig, write_rig
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.imaging import read_image
from gsdmsr_cli.scene.scene import View

FRAMES, RATE = 20, 10


@given(st.lists(st.integers(1, 4), min_size=5, max_size=30), st.integers(2, 40))
def test_a_moment_has_the_nearest_frame_or_none(gaps: list[int], count: int) -> None:
    clock = np.cumsum(gaps) / RATE
    moments = np.linspace(clock[0], clock[-1], count)
    found = frames_at(clock, moments)
    most = NEAR * np.median(gaps[1:]) / RATE
    for moment, frame in zip(moments, found, strict=True):
        apart = np.abs(clock - moment)
        if frame < 0:
            assert apart.min() > most - 1e-9
        else:
            assert apart[frame] == apart.min() <= most + 1e-9


def test_a_camera_without_gaps_has_a_frame_at_every_moment() -> None:
    for rate, late in ((24, 0.0), (30, 0.013), (50, -0.4)):
        clocks = [np.arange(90) / 30, late + np.arange(3 * rate) / rate]
        moments = common_moments(clocks, 60, Path())
        assert all((frames_at(clock, moments) >= 0).all() for clock in clocks)
        assert doubts_about(["a", "b"], clocks, moments) == []


def test_a_camera_that_stops_early_is_named() -> None:
    clocks = [np.arange(100) / 10, np.arange(20) / 10, np.arange(98) / 10]
    moments = common_moments(clocks, 60, Path())
    (told,) = doubts_about(["a.mp4", "b.mp4", "c.mp4"], clocks, moments)
    assert told.startswith("only 1.9 s are taken, in which all cameras film: without b.mp4")
    assert "films for 1.9 s, it would be 9.7 s" in told


def rig(folder: Path, lost: Sequence[int] = ()) -> Path:
    """Four cameras, whose pictures get brighter; the second has lost some frames."""
    folder.mkdir()
    for camera, pose in enumerate(room.walk(4, reach=0.6)):
        still = room.draw(pose, 160, 120)[0] // 2
        taken = [i for i in range(FRAMES) if camera != 1 or i not in lost]
        film = [still + np.uint8(6 * i) for i in taken]
        ticks = [i * TICKS // RATE for i in taken]
        write_video(folder / f"cam{camera}.mp4", film, ticks=ticks, options={"crf": "12"})
    return folder


def written(folder: Path, out: Path) -> tuple[list[str], dict[int, list[int]]]:
    """Return the doubts about a rig, and its cameras' moments without a frame."""
    out.mkdir()
    write_rig(out, find_source(folder, "rig"), 60, 1600, {}, lambda done, total: None)
    missing = {camera: sorted(lost) for camera, lost in read_rig(out).missing.items() if lost}
    return list(read_frames(out).doubts), missing


def test_frames_that_a_camera_has_lost_are_left_out_and_the_others_agree(tmp_path: Path) -> None:
    out = tmp_path / "out"
    doubts, missing = written(rig(tmp_path / "rig", lost=[7, 8, 9, 10]), out)
    made = read_rig(out)
    assert len(made.times) == FRAMES - 4 and set(missing) == {1}
    assert doubts == [
        f"cam1.mp4 has no frame at {len(missing[1])} of {FRAMES - 4} moments: it has lost some; "
        "there it is left out"
    ]
    spread = 1.9 * np.arange(FRAMES - 4) / (FRAMES - 5)
    for k in missing[1]:
        assert 0.6 + NEAR / RATE < spread[k] < 1.1 - NEAR / RATE
    for k, time in enumerate(spread):  # what is taken shows the moment that it is said to
        for camera in set(range(4)) - ({1} if k in missing[1] else set()):
            level = read_image(made.folder / f"{camera:02d}_{k:05d}.png").mean()
            start = read_image(made.folder / f"{camera:02d}_00000.png").mean()
            assert level - start == pytest.approx(60 * time, abs=0.6 * 6 + 1)
    camera = Camera(np.eye(4), 10.0, 10.0, 5.0, 5.0, 10, 10)
    views = made.views([View(str(i), camera, 0.0, "train", Path()) for i in range(4)])
    assert len(views) == 4 * (FRAMES - 4) - len(missing[1])
    assert not any((made.folder.parent / view.image_path).name == "" for view in views)
    assert {view.image_path.name for view in views} == {p.name for p in made.folder.iterdir()}


def test_a_broken_video_among_others_is_left_out_and_named(tmp_path: Path) -> None:
    folder = rig(tmp_path / "rig")
    (folder / "cam2.mp4").write_bytes((folder / "cam2.mp4").read_bytes()[:500])
    doubts, missing = written(folder, tmp_path / "out")
    assert read_rig(tmp_path / "out").cameras == ("cam0", "cam1", "cam3") and not missing
    (told,) = doubts
    assert told.startswith("cam2.mp4 is left out of the rig: no video stream can be read from it")
    assert str(tmp_path) not in json.dumps(doubts), "a scene does not depend on where its input is"
    (folder / "cam3.mp4").write_bytes(b"")
    with pytest.raises(DataError, match="2 of 4 videos can be read; a rig has at least 3") as e:
        written(folder, tmp_path / "again")
    assert "cam2.mp4 is left out of the rig: no video stream" in str(e.value)
