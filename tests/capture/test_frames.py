"""Which pictures become frames, at which times, and what their EXIF tags do to them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.capture.candidates import Candidate, choose, leave_out_blurred
from gsdmsr_cli.capture.exif import FULL_FRAME_DIAGONAL, read_exif, upright
from gsdmsr_cli.capture.frames import read_frames, sharpness, write_frames
from gsdmsr_cli.capture.source import Source, find_source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.native import OpenImageIO


def silent(done: int, total: int) -> None:
    assert 0 <= done <= total


@given(
    st.lists(st.tuples(st.floats(0.01, 3), st.floats(0, 10)), min_size=2, max_size=60),
    st.integers(2, 20),
)
def test_each_part_of_the_time_gives_its_sharpest(
    steps: list[tuple[float, float]], count: int
) -> None:
    times = np.cumsum([step for step, _ in steps])
    given_ = [
        Candidate("a", i, t, s) for i, (t, (_, s)) in enumerate(zip(times, steps, strict=True))
    ]
    chosen = choose(given_, count)
    assert len(chosen) <= max(count, 2) and [c.time for c in chosen] == sorted(
        {c.time for c in chosen}
    )
    if len(given_) <= count:
        assert chosen == given_
        return
    edges = np.linspace(times[0], times[-1], count + 1)
    for candidate in given_:  # none in the middle of a part is sharper than what was taken there
        part = np.searchsorted(edges, candidate.time, side="right") - 1
        near = edges[np.clip([part, part + 1], 0, count)] + [-1e-9, 1e-9]
        rivals = [c for c in chosen if near[0] <= c.time <= near[1]]
        if edges[part] + 1e-9 < candidate.time < near[1] - 1e-6:
            assert rivals and max(c.sharpness for c in rivals) >= candidate.sharpness


def test_a_blurred_frame_among_sharp_ones_is_left_out() -> None:
    frames = [Candidate("a", i, float(i), 100.0) for i in range(9)]
    dull = [Candidate("a", i, float(i), 3.0) for i in range(9, 30)]
    blurred = Candidate("a", 4, 4.0, 12.0)
    taken, left = leave_out_blurred([*frames[:4], blurred, *frames[5:], *dull])
    assert left == [blurred] and len(taken) == 29


def test_blur_lowers_sharpness_whatever_the_size() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (700, 900, 3), dtype=np.uint8)
    soft = cv2.GaussianBlur(picture, (0, 0), 4)
    assert sharpness(np.asarray(soft)) < 0.05 * sharpness(picture)


def write_jpeg(path: Path, pixels: np.ndarray, **notes: object) -> None:
    out = OpenImageIO.ImageOutput.create(str(path))
    spec = OpenImageIO.ImageSpec(pixels.shape[1], pixels.shape[0], 3, "uint8")
    for key, value in notes.items():
        spec[key.replace("_", ":", 1)] = value
    out.open(str(path), spec)
    out.write_image(pixels)
    out.close()


def test_notes_of_a_camera_are_read(tmp_path: Path) -> None:
    pixels = np.zeros((20, 30, 3), np.uint8)
    write_jpeg(
        tmp_path / "a.jpg", pixels, Orientation=6, Exif_FocalLengthIn35mmFilm=26,
        Exif_DateTimeOriginal="2026:03:01 12:00:05", Exif_SubsecTimeOriginal="25",
    )  # fmt: skip
    notes = read_exif(tmp_path / "a.jpg")
    assert notes.orientation == 6 and notes.focal == pytest.approx(26 / FULL_FRAME_DIAGONAL)
    cv2.imwrite(str(tmp_path / "plain.png"), pixels)
    assert read_exif(tmp_path / "plain.png").taken is None
    assert notes.taken is not None and notes.taken % 60 == pytest.approx(5.25)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_as_opencv_turns_them(tmp_path: Path, orientation: int) -> None:
    """OpenCV's JPEG reader honours the tag, and is the oracle."""
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    pixels = np.kron(coarse, np.ones((16, 16, 1), np.uint8))
    write_jpeg(tmp_path / "a.jpg", pixels, Orientation=orientation)
    stored = cv2.imread(str(tmp_path / "a.jpg"), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    expected = cv2.imread(str(tmp_path / "a.jpg"))
    np.testing.assert_array_equal(upright(np.asarray(stored), orientation), expected)


def pictures(folder: Path, names: list[str], size: tuple[int, int] = (24, 32)) -> Source:
    rng = np.random.default_rng(0)
    for name in names:
        cv2.imwrite(str(folder / name), rng.integers(0, 256, (*size, 3), dtype=np.uint8))
    return find_source(folder)


def test_numbers_in_names_are_times(tmp_path: Path) -> None:
    numbers = [1, 2, 3, 5, 8, 13, 21, 34]
    source = pictures(tmp_path, [f"p_{n}.png" for n in numbers])
    folder = tmp_path / "frames"
    folder.mkdir()
    write_frames(folder, source, 60, 1600, silent)
    frames = read_frames(folder)
    assert [frame.file for frame in frames.taken] == [f"p_{n}.png" for n in numbers]
    assert frames.times == pytest.approx([(n - 1) / 33 for n in numbers])
    assert frames.duration is None and frames.focal is None


def test_the_moment_a_picture_was_taken_counts_more_than_its_name(tmp_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    for i in range(9):
        moment = f"2026:03:01 12:00:{50 - 5 * i:02d}"
        write_jpeg(
            tmp_path / f"p{i}.jpg", pixels, Exif_DateTimeOriginal=moment,
            Exif_FocalLengthIn35mmFilm=26, Orientation=6,
        )  # fmt: skip
    folder = tmp_path / "frames"
    folder.mkdir()
    write_frames(folder, find_source(tmp_path), 60, 24, silent)
    frames = read_frames(folder)
    assert [frame.file for frame in frames.taken] == [f"p{i}.jpg" for i in reversed(range(9))]
    assert frames.duration == pytest.approx(40) and frames.size == (16, 24)
    assert frames.focal == pytest.approx(26 / FULL_FRAME_DIAGONAL * np.hypot(16, 24))


def test_too_few_pictures_are_refused(tmp_path: Path) -> None:
    source = pictures(tmp_path, ["1.png", "2.png", "3.png"])
    (tmp_path / "frames").mkdir()
    with pytest.raises(DataError, match="3 usable frames of 3; at least 8 are needed"):
        write_frames(tmp_path / "frames", source, 60, 1600, silent)


def test_what_a_folder_holds_is_recognised(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="does not exist"):
        find_source(tmp_path / "nowhere")
    with pytest.raises(DataError, match="holds no pictures or videos"):
        find_source(tmp_path)
    pictures(tmp_path, ["1.png"])
    assert find_source(tmp_path).kind == "images"
    with pytest.raises(DataError, match="holds no videos"):
        find_source(tmp_path, "video")
    (tmp_path / "a.MP4").touch()
    with pytest.raises(DataError, match="holds 1 videos and 1 pictures; choose with --format"):
        find_source(tmp_path)
    assert [path.name for path in find_source(tmp_path, "video").files] == ["a.MP4"]
    with pytest.raises(DataError, match="is a file"):
        find_source(tmp_path / "1.png", "images")
