"""Videos: read back by an independent decoder, and what cannot be written is told."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageSequence

from gsdmsr_cli.filming.encode import ENCODINGS, require_encoder, write_video
from gsdmsr_cli.filming.request import VIDEOS
from gsdmsr_cli.ground.errors import GsdmsrError, UsageError
from gsdmsr_cli.scene.native import load_av

COLOURS = [(220, 30, 30), (30, 200, 30), (40, 40, 210), (250, 250, 250)]
EACH = pytest.mark.parametrize("kind", ENCODINGS)


def plain(height: int, width: int) -> list[np.ndarray]:
    return [np.full((height, width, 3), colour, np.uint8) for colour in COLOURS]


def opened(path: Path) -> tuple[float, list[np.ndarray]]:
    """Return the frames a second, and the frames in RGB, as OpenCV or Pillow sees them."""
    if path.read_bytes()[8:12] == b"WEBP":
        durations, frames = animation(path)
        return 1000 * len(frames) / sum(durations), frames
    capture = cv2.VideoCapture(str(path))
    rate, frames = capture.get(cv2.CAP_PROP_FPS), []
    while (frame := capture.read()[1]) is not None:
        frames.append(frame[..., ::-1])
    return rate, frames


def animation(path: Path) -> tuple[list[int], list[np.ndarray]]:
    """Return how long [ms] the frames of an animated WebP last, and the frames in RGB."""
    durations, frames = [], []
    with Image.open(path) as picture:
        for frame in ImageSequence.Iterator(picture):
            frames.append(np.asarray(frame.convert("RGB")))
            durations.append(int(frame.info["duration"]))
    return durations, frames


def test_every_kind_that_can_be_asked_for_has_an_encoding() -> None:
    assert tuple(ENCODINGS) == VIDEOS


@EACH
@pytest.mark.parametrize(("height", "width"), [(32, 48), (33, 47), (9, 7), (2, 2)])
def test_a_video_holds_every_frame_with_even_sides(
    tmp_path: Path, kind: str, height: int, width: int, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"a.{kind}"
    write_video(kind, path, iter(plain(height, width)), 12.5)
    rate, frames = opened(path)
    assert rate == pytest.approx(12.5)
    assert len(frames) == len(COLOURS)
    for frame, colour in zip(frames, COLOURS, strict=True):
        odd = (height % 2, width % 2) if kind != "webp" else (0, 0)
        assert frame.shape == (height + odd[0], width + odd[1], 3)
        assert np.abs(frame.mean((0, 1)) - colour).max() < 8
    assert list(tmp_path.iterdir()) == [path]
    assert capfd.readouterr() == ("", "")


@EACH
def test_a_moving_picture_is_kept_well(tmp_path: Path, kind: str) -> None:
    """A drifting pattern of strong colours, of which half the resolution is kept."""
    y, x = np.mgrid[:96, :128].astype(np.float64)
    films = [
        np.stack([128 + 100 * np.sin((x + 2 * i) / 9), 128 + 100 * np.cos(y / 7), x + y], -1)
        for i in range(20)
    ]
    true = [np.clip(film, 0, 255).astype(np.uint8) for film in films]
    write_video(kind, tmp_path / "a", true, 30)
    _, frames = opened(tmp_path / "a")
    error = np.mean([(a.astype(float) - b) ** 2 for a, b in zip(frames, true, strict=True)])
    assert 10 * np.log10(255**2 / error) > 34
    assert (tmp_path / "a").stat().st_size < 0.1 * len(true) * true[0].nbytes


def test_an_mp4_says_which_colours_it_has_and_can_be_played_while_it_loads(tmp_path: Path) -> None:
    write_video("mp4", tmp_path / "a.mp4", plain(32, 48), 30)
    with load_av().open(str(tmp_path / "a.mp4")) as container:
        context = container.streams.video[0].codec_context
        bt709 = 1
        assert (context.color_primaries, context.color_trc, context.colorspace) == 3 * (bt709,)
        assert context.pix_fmt == "yuv420p"
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")


def test_an_animated_picture_loops_for_ever_at_its_rate(tmp_path: Path) -> None:
    """A frame lasts whole milliseconds, and 30 of them last a second all the same."""
    films = [np.full((16, 16, 3), 8 * i, np.uint8) for i in range(30)]
    write_video("webp", tmp_path / "a.webp", films, 30)
    durations, frames = animation(tmp_path / "a.webp")
    assert set(durations) == {33, 34} and 999 <= sum(durations) <= 1000
    for frame, true in zip(frames, films, strict=True):
        assert np.abs(frame.astype(int) - true).max() <= 3
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.info["loop"] == 0  # which is without end


@EACH
def test_videos_need_frames_of_one_size(tmp_path: Path, kind: str) -> None:
    with pytest.raises(GsdmsrError, match="at least one frame"):
        write_video(kind, tmp_path / "a", [], 24)
    with pytest.raises(ValueError, match="frame 1 has shape"):
        write_video(kind, tmp_path / "a", [*plain(4, 4)[:1], *plain(4, 6)], 24)
    assert list(tmp_path.iterdir()) == []


@EACH
def test_an_interruption_leaves_nothing_behind(tmp_path: Path, kind: str) -> None:
    def frames():
        yield from plain(32, 48)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(kind, tmp_path / "a", frames(), 24)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["webm", "webp"])
def test_what_the_encoder_refuses_is_told_in_its_words(tmp_path: Path, kind: str) -> None:
    huge = np.zeros((2, 20000, 3), np.uint8)  # VP8 and WebP have 14 bits for a side
    words = rf"{ENCODINGS[kind].encoder} cannot encode 20000 x 2 px.*--size"
    with pytest.raises(GsdmsrError, match=words) as caught:
        write_video(kind, tmp_path / f"a.{kind}", [huge], 24)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@EACH
def test_an_encoder_that_is_not_there_is_told(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(load_av(), "codecs_available", set())
    encoder = ENCODINGS[kind].encoder
    with pytest.raises(UsageError, match=f"--video {kind} needs the encoder {encoder}, which"):
        require_encoder(kind)
    with pytest.raises(UsageError):
        write_video(kind, tmp_path / "a", plain(4, 4), 24)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on the size of files")
@EACH
def test_a_video_that_does_not_fit_on_the_disk_is_refused(tmp_path: Path, kind: str) -> None:
    program = f"""
import resource, signal
from pathlib import Path
import numpy as np
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.filming.encode import write_video
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
rng = np.random.default_rng(0)
frames = (rng.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(40))
try:
    write_video({kind!r}, Path({str(tmp_path / "a")!r}), frames, 24)
except DataError as error:
    print(error)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert "File too large; is the disk full?" in run.stdout, run.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(GsdmsrError, match="No such file"):
        write_video("webm", tmp_path / "none" / "a.webm", plain(4, 4), 24)
