"""Videos as phones and editors make them: short, upright, of 10 bits, uneven in time, black."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import room
from test_prepare import prepare
from videos import TICKS, write_video

from gsdmsr_cli.capture.candidates import PLAIN, Candidate, leave_out_plain
from gsdmsr_cli.capture.frames import Frames, read_frames, sharpness, write_frames
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.high_range import high_ranges
from gsdmsr_cli.scene.video import read_video

HLG = {"x265-params": "log-level=none:transfer=arib-std-b67:colorprim=bt2020:colormatrix=bt2020nc"}
QUIET = {"x265-params": "log-level=none"}


@pytest.fixture(scope="module")
def shots() -> np.ndarray:
    return room.film(room.walk(60), 96, 64).pictures


def frames_of(video: Path, count: int = 60) -> Frames:
    folder = video.parent / "frames"
    folder.mkdir()
    write_frames(folder, find_source(video), count, 1600, lambda done, total: None)
    return read_frames(folder)


def test_ten_bits_of_hevc_are_read_as_eight(tmp_path: Path) -> None:
    levels = [25 * i for i in range(10)]
    greys = [np.full((64, 96, 3), level, np.uint8) for level in levels]
    path = write_video(tmp_path / "a.mp4", greys, "libx265", "yuv420p10le", options=QUIET)
    found = [picture for _, picture in read_video(path)]
    assert {picture.dtype for picture in found} == {np.dtype(np.uint8)}
    assert [picture.mean() for picture in found] == pytest.approx(levels, abs=3)
    assert high_ranges([path]) == []


def test_an_upright_video_stays_upright(tmp_path: Path) -> None:
    tall = room.film(room.walk(12), 64, 96).pictures
    frames = frames_of(write_video(tmp_path / "tall.mp4", tall))
    assert frames.size == (64, 96) and len(frames.names) == 12


@pytest.mark.parametrize("codec", ["libx264", "libvpx-vp9"])
def test_uneven_times_are_those_in_the_file(shots: np.ndarray, tmp_path: Path, codec: str) -> None:
    """Where frames are stored in another order than they are shown, too."""
    steps = np.random.default_rng(0).integers(6, 90, 60)
    path = tmp_path / ("a.mp4" if codec == "libx264" else "a.webm")
    write_video(path, shots, codec, ticks=steps.cumsum(), options={"g": "12"})
    times = np.array([time for time, _ in read_video(path)])
    expected = (steps.cumsum() - steps[0]) / TICKS
    np.testing.assert_allclose(times, expected, atol=1.1e-3)  # WebM counts milliseconds


def test_two_seconds_are_enough_and_too_few_frames_are_told(
    shots: np.ndarray, tmp_path: Path
) -> None:
    frames = frames_of(write_video(tmp_path / "a.mp4", shots), 40)
    assert len(frames.names) == 40 and frames.duration == pytest.approx(59 / 30, abs=0.05)
    (tmp_path / "few").mkdir()
    few = write_video(tmp_path / "few" / "a.mp4", shots[:4], ticks=range(0, 4 * TICKS, TICKS))
    with pytest.raises(DataError, match="4 usable frames of 4; at least 8 are needed: film for"):
        frames_of(few)


def test_black_frames_are_left_out_and_counted(shots: np.ndarray, tmp_path: Path) -> None:
    """Every sixth picture, and at both ends more of them than a frame has neighbours."""
    shown = np.where((np.arange(60) % 6 == 3)[:, None, None, None], 0, shots)
    dark = np.zeros_like(shots[:12])
    film = np.concatenate([dark, *_faded(shots[0]), shown, *_faded(shots[-1])[::-1], dark])
    frames = frames_of(write_video(tmp_path / "a.mp4", film, options={"crf": "12"}), 200)
    taken = {frame.index for frame in frames.taken}
    black = {i for i, picture in enumerate(film) if not picture.any()}
    assert not taken & black and frames.plain >= len(black) == 34
    assert len(taken) + len(frames.blurred) + frames.plain == len(film)
    assert frames.times[0] == 0 and frames.times[-1] == 1


def _faded(picture: np.ndarray) -> list[np.ndarray]:
    """Return the picture getting brighter over six frames, each (1, H, W, 3)."""
    return [(picture * share).astype(np.uint8)[None] for share in np.linspace(0.1, 0.9, 6)]


def test_a_video_of_nothing_but_black_is_told(shots: np.ndarray, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", np.zeros_like(shots))
    with pytest.raises(DataError, match="0 usable frames of 60, 60 of them black or of one colour"):
        frames_of(path)


def test_dark_pictures_that_show_something_are_not_black(shots: np.ndarray) -> None:
    dim = [(picture * 0.1).astype(np.uint8) for picture in shots[::10]]
    found = [Candidate("a", i, float(i), sharpness(picture)) for i, picture in enumerate(dim)]
    assert leave_out_plain(found) == found
    assert sharpness(np.full((64, 96, 3), 70, np.uint8)) < PLAIN


def test_high_dynamic_range_is_named(shots: np.ndarray, tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.mp4", shots, "libx265", "yuv420p10le", options=HLG)
    assert high_ranges([path]) == [("a.mp4", "HLG")]
    assert frames_of(path).high_range == (("a.mp4", "HLG"),)
    (tmp_path / "none.mp4").write_bytes(b"no video")
    assert high_ranges([tmp_path / "none.mp4", tmp_path / "absent.mp4"]) == []


@pytest.mark.parametrize("inverted", [False, True])
def test_masks_that_cover_everything_are_told(tmp_path: Path, inverted: bool) -> None:
    shots = room.film(room.walk(9), 160, 120)
    pictures = room.write_pictures(tmp_path / "pictures", shots)
    level = 0 if inverted else 255
    masks = np.full((9, 120, 160, 3), level, np.uint8)
    room.write_pictures(tmp_path / "masks", room.Shots(masks, shots.poses, shots.moving))
    given = "--masks", tmp_path / "masks", *(["--invert-masks"] if inverted else [])
    ended = prepare(pictures, "--out", tmp_path / "scene", *given, "--json")
    error = json.loads(ended.stdout)["error"]
    assert ended.returncode == 3 and not (tmp_path / "scene").exists()
    assert "masks cover more than 98 % of 9 of 9 frames, so nothing is left" in error["message"]
    remedy = "drop --invert-masks" if inverted else "--invert-masks takes black for it"
    assert error["message"].endswith(remedy)
