"""Frames of videos and their times, from files that tests write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import room

from gsdmsr_cli.capture.frames import read_frames, write_frames
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.video import read_video, video_length


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    shots = room.film(room.walk(30), width=96, height=64)
    return room.write_film(tmp_path_factory.mktemp("film") / "film.mp4", shots, fps=12.5)


def test_times_are_those_in_the_file(film: Path) -> None:
    times = [time for time, _ in read_video(film)]
    assert times == pytest.approx([i / 12.5 for i in range(30)], abs=1e-3)
    assert video_length(film) == 30


def test_frames_are_rgb(film: Path) -> None:
    expected = room.draw(room.walk(30)[0], 96, 64)[0]
    _, first = next(read_video(film))
    assert np.abs(first.astype(float) - expected).mean() < 12  # what MPEG-4 leaves of it


def test_a_file_that_is_no_video_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video" * 100)
    with pytest.raises(DataError, match=r"a\.mp4: no video stream can be read"):
        list(read_video(tmp_path / "a.mp4"))


def test_a_video_without_its_end_is_told(film: Path, tmp_path: Path) -> None:
    """Its index, at the end of an .mp4, is missing."""
    data = film.read_bytes()
    (tmp_path / "cut.mp4").write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match="cut short"):
        list(read_video(tmp_path / "cut.mp4"))


def test_a_video_that_loses_frames_is_told(film: Path, tmp_path: Path) -> None:
    """An .mp4 whose index comes first is cut short in the middle of its pictures."""
    data = film.read_bytes()
    index = data.rindex(b"moov") - 4
    media = data.index(b"mdat") - 4
    moov = bytearray(data[index:])
    table = moov.index(b"stco") + 12  # chunk offsets, 32 bits each, after their number
    count = int.from_bytes(moov[table - 4 : table], "big")
    for i in range(count):
        at = slice(table + 4 * i, table + 4 * i + 4)
        moov[at] = (int.from_bytes(moov[at], "big") + len(moov)).to_bytes(4, "big")
    whole = data[:media] + bytes(moov) + data[media:index]
    (tmp_path / "whole.mp4").write_bytes(whole)
    assert len(list(read_video(tmp_path / "whole.mp4"))) == 30
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) - (index - media) // 2])
    with pytest.raises(DataError, match=r"is cut short: \d+ of 30 frames can be decoded"):
        list(read_video(tmp_path / "cut.mp4"))


def test_several_clips_follow_one_another(film: Path, tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / name).write_bytes(film.read_bytes())
    folder = tmp_path / "frames"
    folder.mkdir()
    write_frames(folder, find_source(tmp_path), 100, 1600, lambda done, total: None)
    frames = read_frames(folder)
    assert [frame.file for frame in frames.taken] == 30 * ["a.mp4"] + 30 * ["b.mp4"]
    times = [frame.time for frame in frames.taken]
    assert times == pytest.approx([i / 12.5 for i in range(60)], abs=2e-3)
    assert frames.size == (96, 64) and frames.duration == pytest.approx(59 / 12.5, abs=2e-3)


def patched(data: bytes, path: tuple[bytes, ...], change: Callable[[bytes], bytes]) -> bytes:
    """Return an .mp4 with the content of one box changed, and its and its parents' sizes."""
    at = 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        if data[at + 4 : at + 8] == path[0]:
            content = data[at + 8 : at + size]
            content = patched(content, path[1:], change) if path[1:] else change(content)
            head = (len(content) + 8).to_bytes(4, "big") + path[0]
            return data[:at] + head + content + data[at + size :]
        at += size
    raise KeyError(path[0])


def test_a_variable_frame_rate_is_kept(film: Path, tmp_path: Path) -> None:
    """The table of durations says: 10 frames as they were, 20 of a quarter of the length."""
    table = b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stts"

    def hurry(content: bytes) -> bytes:
        delta = int.from_bytes(content[12:16], "big")
        numbers = (2, 10, delta, 20, delta // 4)
        return content[:4] + b"".join(n.to_bytes(4, "big") for n in numbers)

    (tmp_path / "a.mp4").write_bytes(patched(film.read_bytes(), table, hurry))
    times = [time for time, _ in read_video(tmp_path / "a.mp4")]
    expected = np.cumsum([0] + 10 * [1 / 12.5] + 19 * [1 / 50])
    assert times == pytest.approx(expected.tolist(), abs=2e-3)


def test_a_rotation_that_a_phone_has_noted_is_applied(film: Path, tmp_path: Path) -> None:
    """The matrix of the track turns the picture by 90 degrees clockwise."""

    def turn(content: bytes) -> bytes:
        one = 1 << 16
        matrix = (0, one, 0, -one, 0, 0, 64 * one, 0, 1 << 30)
        numbers = b"".join(n.to_bytes(4, "big", signed=True) for n in matrix)
        return content[:40] + numbers + content[76:]

    (tmp_path / "a.mp4").write_bytes(patched(film.read_bytes(), (b"moov", b"trak", b"tkhd"), turn))
    _, plain = next(read_video(film))
    _, turned = next(read_video(tmp_path / "a.mp4"))
    np.testing.assert_array_equal(turned, np.rot90(plain, -1))
