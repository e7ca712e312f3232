"""H.264 by ffmpeg: what the program is told, how its failures are told, and a real video."""

from __future__ import annotations

import shutil
import stat
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsdmsr_cli.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.filming.mp4 import require_ffmpeg, write_mp4

FRAMES = [np.full((5, 7, 3), value, np.uint8) for value in (10, 20, 30)]


def program(folder: Path, body: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put an ffmpeg on PATH that runs a few lines of Python."""
    path = folder / "bin" / "ffmpeg"
    path.parent.mkdir()
    path.write_text(f"#!{sys.executable}\nimport sys\nwords = sys.argv\n{body}")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", str(path.parent))


def test_without_ffmpeg_there_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match=r"needs the program ffmpeg.*--video webm"):
        write_mp4(tmp_path / "a.mp4", FRAMES, 30)
    with pytest.raises(UsageError):
        require_ffmpeg()


@pytest.mark.skipif(sys.platform == "win32", reason="needs a script that can be run")
def test_ffmpeg_gets_every_frame_with_even_sides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = "open(words[-1], 'wb').write(sys.stdin.buffer.read())"
    program(tmp_path, f"assert words[words.index('-s') + 1] == '8x6', words\n{copy}", monkeypatch)
    write_mp4(tmp_path / "a.mp4", iter(FRAMES), 30)
    raw = np.frombuffer((tmp_path / "a.mp4").read_bytes(), np.uint8).reshape(3, 6, 8, 3)
    assert [frame.flat[0] for frame in raw] == [10, 20, 30]
    assert all((frame == frame.flat[0]).all() for frame in raw)
    assert {path.name for path in tmp_path.iterdir()} == {"bin", "a.mp4"}


@pytest.mark.skipif(sys.platform == "win32", reason="needs a script that can be run")
@pytest.mark.parametrize("read", ["sys.stdin.buffer.read()", "pass"])
def test_a_failure_of_ffmpeg_is_told_in_its_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: str
) -> None:
    said = "print('Unknown encoder libx264', file=sys.stderr)"
    program(tmp_path, f"{read}\nopen(words[-1], 'wb')\n{said}\nsys.exit(1)", monkeypatch)
    many = (np.zeros((200, 200, 3), np.uint8) for _ in range(20))  # more than a pipe holds
    with pytest.raises(DataError, match=r"a\.mp4: .*ffmpeg: Unknown encoder libx264") as caught:
        write_mp4(tmp_path / "a.mp4", many, 30)
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["bin"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs a script that can be run")
def test_an_interruption_ends_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(tmp_path, "open(words[-1], 'wb')\nsys.stdin.buffer.read()", monkeypatch)

    def frames():
        yield FRAMES[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_mp4(tmp_path / "a.mp4", frames(), 30)
    assert [path.name for path in tmp_path.iterdir()] == ["bin"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs a script that can be run")
def test_a_video_needs_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(tmp_path, "pass", monkeypatch)
    with pytest.raises(GsdmsrError, match="at least one frame"):
        write_mp4(tmp_path / "a.mp4", [], 30)


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="there is no ffmpeg on PATH")
def test_a_real_video_has_the_colours_of_its_frames(tmp_path: Path) -> None:
    colours = [(220, 30, 30), (30, 200, 30), (40, 40, 210)]
    write_mp4(tmp_path / "a.mp4", (np.full((33, 47, 3), c, np.uint8) for c in colours), 12)
    capture = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(12)
    for colour in colours:
        frame = capture.read()[1][..., ::-1]
        assert frame.shape == (34, 48, 3)
        assert np.abs(frame.mean((0, 1)) - colour).max() < 8
    assert not capture.read()[0]
