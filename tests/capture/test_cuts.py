"""Where a video has been cut, and that only its longest shot becomes frames."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.capture.cuts import change, find_cuts, longest_shot, thumbnail
from gsdmsr_cli.capture.frames import read_frames, write_frames
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.video import read_video

FPS = 10.0


def pan(seed: int, frames: int, speed: int = 2) -> list[np.ndarray]:
    """A camera that goes along a wall of soft spots."""
    rng = np.random.default_rng(seed)
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (64, 600, 3)), (0, 0), 6)
    wall = ((wall - wall.min()) / np.ptp(wall) * 255).astype(np.uint8)
    return [wall[:, speed * i : speed * i + 96] for i in range(frames)]


def written(path: Path, pictures: list[np.ndarray]) -> Path:
    codec = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, FPS, (96, 64))
    for picture in pictures:
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    return path


def changes_of(pictures: list[np.ndarray]) -> list[float]:
    seen = [thumbnail(picture) for picture in pictures]
    return [change(a, b) for a, b in itertools.pairwise(seen)]


def test_cuts_are_found_and_neither_pans_nor_flashes() -> None:
    assert find_cuts(changes_of([*pan(1, 20), *pan(2, 30), *pan(3, 10)])) == [20, 50]
    assert find_cuts(changes_of([*pan(1, 20), *pan(1, 40)[30:]])) == [20]  # the same wall later
    assert find_cuts(changes_of(pan(1, 40, speed=12))) == []
    flash = pan(1, 40)
    flash[17] = np.full_like(flash[17], 255)
    assert find_cuts(changes_of(flash)) == []
    assert find_cuts(changes_of(pan(1, 1))) == find_cuts([]) == []


def test_one_frame_before_a_cut_and_one_after_are_shots() -> None:
    assert find_cuts([80.0]) == [1]
    assert find_cuts([1.0, 80.0]) == [2] and find_cuts([80.0, 1.0]) == [1]


@given(st.lists(st.floats(0.01, 2), min_size=1, max_size=30), st.data())
def test_the_shot_that_lasts_longest(steps: list[float], data: st.DataObject) -> None:
    times = np.cumsum(steps).tolist()
    cuts = sorted(data.draw(st.sets(st.integers(1, len(times) - 1)))) if len(times) > 1 else []
    shot = longest_shot(times, cuts)
    assert shot.start in (0, *cuts) and shot.stop in (*cuts, len(times))
    assert not any(shot.start < cut < shot.stop for cut in cuts)
    ends = [0, *cuts, len(times)]
    lengths = [times[b - 1] - times[a] for a, b in itertools.pairwise(ends)]
    assert times[shot.stop - 1] - times[shot.start] == max(lengths)


def test_frames_are_of_the_longest_shot_and_cuts_are_named(tmp_path: Path) -> None:
    film = written(tmp_path / "film.mp4", [*pan(1, 12), *pan(2, 30), *pan(3, 9)])
    folder = tmp_path / "frames"
    folder.mkdir()
    write_frames(folder, find_source(film), 60, 96, lambda done, total: None)
    frames = read_frames(folder)
    assert [frame.index for frame in frames.taken] == list(range(12, 42))
    assert frames.cuts == (("film.mp4", pytest.approx(1.2)), ("film.mp4", pytest.approx(4.2)))


def test_videos_that_follow_each_other_are_not_cut(tmp_path: Path) -> None:
    shots = tmp_path / "shots"
    shots.mkdir()
    written(shots / "a.mp4", pan(1, 12))
    written(shots / "b.mp4", pan(2, 12))
    folder = tmp_path / "frames"
    folder.mkdir()
    write_frames(folder, find_source(shots), 60, 96, lambda done, total: None)
    frames = read_frames(folder)
    assert len(frames.taken) == 24 and not frames.cuts


def test_a_film_of_short_shots_is_refused_with_their_number(tmp_path: Path) -> None:
    film = written(tmp_path / "film.mp4", [p for seed in range(5) for p in pan(seed, 6)])
    folder = tmp_path / "frames"
    folder.mkdir()
    message = "6 usable frames of 6, in the longest of 5 shots; at least 8"
    with pytest.raises(DataError, match=message):
        write_frames(folder, find_source(film), 60, 96, lambda done, total: None)


@pytest.mark.skipif("GSDMSR_DATA" not in os.environ, reason="GSDMSR_DATA is not set")
def test_phone_videos_are_one_shot_and_two_in_one_file_are_two() -> None:
    folder = Path(os.environ["GSDMSR_DATA"]) / "video"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    films = [[p for _, p in read_video(folder / name)] for name in ("dog.mp4", "cake.mp4")]
    for film in films:
        assert find_cuts(changes_of(film)) == []
    assert find_cuts(changes_of(films[0] + films[1])) == [len(films[0])]
