"""Videos whose clock jumps, that change their size, or that are lists of other files."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import video
from gsdmsr_cli.scene.video import read_video, video_length


def write(
    path: Path, stamps: Iterable[int], size: tuple[int, int] = (64, 48), codec: str = "mpeg4"
) -> Path:
    """Write frames that are shown at ``stamps`` / 25 s."""
    codec = "mpeg2video" if path.suffix == ".ts" else codec
    with av.open(str(path), "w", format="mpegts" if path.suffix == ".ts" else None) as out:
        stream = out.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 25)
        stream.codec_context.max_b_frames = 0
        for i, stamp in enumerate(stamps):
            pixels = np.full((size[1], size[0], 3), 9 * i % 255, np.uint8)
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            frame.pts = stamp
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path


def times(path: Path) -> list[float]:
    found = [time for time, _ in read_video(path)]
    assert found[0] == 0 and all(later > earlier for earlier, later in pairwise(found))
    return found


def test_a_clock_that_jumps_ahead_goes_on_from_where_it_was(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4", [*range(10), *range(100_000, 100_010)])
    assert times(path) == pytest.approx([i / 25 for i in range(20)], abs=1e-3)


def test_a_pause_that_a_person_may_have_made_stays(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4", [*range(10), *range(500, 510)])
    assert times(path)[9:12] == pytest.approx([9 / 25, 500 / 25, 501 / 25], abs=1e-3)


def test_frames_that_are_far_apart_stay_so(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4", range(0, 20 * 1000, 1000))
    assert times(path) == pytest.approx([40 * i for i in range(20)], abs=1e-3)


def test_a_clock_that_begins_anew_goes_on(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.ts", range(20)).read_bytes()
    (tmp_path / "twice.ts").write_bytes(whole + whole)
    assert times(tmp_path / "twice.ts") == pytest.approx([i / 25 for i in range(40)], abs=1e-3)


@pytest.mark.parametrize(
    "stamps",
    [
        [0.0, 5.0, 1e9, 1e9 + 1, 1e9 + 2], [9.0, 3.0, 3.0, 3.5, 4.0], [float("nan")] * 5,
        [0.0, float("inf"), float("-inf"), 1.0, 2.0], [0.0, 1e-300, 2e-300, 0.0, 1.0],
        [1e300, -1e300, 1e300, 0.0, 1.0],
    ],
)  # fmt: skip
def test_times_ascend_whatever_the_stamps(stamps: list[float]) -> None:
    clock = video._Clock(1 / 30)
    found = []
    for stamp in stamps:
        clock.advance(stamp)
        found.append(clock.time)
    assert found[0] == 0 and all(later > earlier for earlier, later in pairwise(found))
    assert found[-1] < 1000


@pytest.mark.parametrize("first", [(64, 48), (32, 32)])
def test_a_video_that_changes_its_size_is_refused(tmp_path: Path, first: tuple[int, int]) -> None:
    second = {(64, 48): (32, 32), (32, 32): (64, 48)}[first]
    parts = [write(tmp_path / f"{s[0]}.ts", range(20), s).read_bytes() for s in (first, second)]
    (tmp_path / "both.ts").write_bytes(b"".join(parts))
    with pytest.raises(DataError, match=f"has frames of {first[0]} x {first[1]} and {second[0]} x"):
        next(read_video(tmp_path / "both.ts"))


def test_a_list_of_other_files_is_no_video(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "real.ts", range(5))
    (tmp_path / "a.mp4").write_text("ffconcat version 1.0\nfile real.ts\n")
    for read in (video_length, lambda path: list(read_video(path))):
        with pytest.raises(DataError, match=r"a\.mp4: no video stream"):
            read(tmp_path / "a.mp4")
    assert capfd.readouterr().err == ""  # nor does OpenCV print


def test_a_video_of_huge_pictures_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "a.mp4", range(5))
    monkeypatch.setattr(video, "MOST_SIDE", 50)
    with pytest.raises(DataError, match="is 64 x 48 px; allowed: up to 50 px a side"):
        next(read_video(path))


def test_a_video_of_pictures_that_its_bytes_cannot_hold_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.webm", range(3), codec="libvpx-vp9")
    content = bytearray(path.read_bytes())
    at = content.index(b"\x49\x83\x42") + 3  # a keyframe; 4 bits later follows its size
    head = int.from_bytes(content[at : at + 5], "big")
    head = (head >> 36 << 36) | (15999 << 20) | (15999 << 4) | (head & 15)
    content[at : at + 5] = head.to_bytes(5, "big")
    path.write_bytes(content)
    for read in (video_length, lambda path: list(read_video(path))):
        with pytest.raises(DataError, match=r"webm: is damaged, or its pictures have more than"):
            read(path)


def test_a_video_of_an_unknown_codec_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.webm", range(3), codec="libvpx-vp9")
    path.write_bytes(path.read_bytes().replace(b"V_VP9", b"V_VPx"))
    with pytest.raises(DataError, match=r"a\.webm: no video stream"):
        video_length(path)


def test_a_video_without_an_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.mp4", range(9))
    monkeypatch.setattr(video, "MOST_FRAMES", 7)
    with pytest.raises(DataError, match="has more than 7 frames; cut it"):
        list(read_video(path))
    assert video_length(path) == 0
