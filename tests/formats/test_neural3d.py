"""The reader of Neural 3D Video, on small videos that the test encodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import noise, write_picture
from full_disk import full_at_every_change, has_failed
from hypothesis import given
from hypothesis import strategies as st
from neural3d_videos import CAMERAS, FRAMES, WIDTH, encode, row, write_n3v
from refusals import assert_refused
from videos import TICKS, write_video

from gsdmsr_cli.formats import _decoded, needs_preparing, read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import read_image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_n3v(tmp_path / "scene")


def test_a_rig_is_read_and_its_first_camera_is_for_testing(folder: Path) -> None:
    told: list[tuple[int, int]] = []
    scene = read_scene(folder, lambda done, total: told.append((done, total)))
    assert scene.layout == "neural3d" and scene.duration == FRAMES / 30
    assert told == [(i + 1, CAMERAS * FRAMES) for i in range(CAMERAS * FRAMES)]
    assert [view.name for view in scene.split("test")] == [f"cam00_{i:04d}" for i in range(FRAMES)]
    assert len(scene.split("train")) == 2 * FRAMES
    assert scene.train_times == [i / 4 for i in range(FRAMES)]
    for view in scene.views:
        level = read_image(view.image_path).mean()
        assert level == pytest.approx(160 * view.time + 20, abs=6)


def test_cameras_are_llffs(folder: Path) -> None:
    scene = read_scene(folder)
    first, last = scene.views[0].camera, scene.views[-1].camera
    np.testing.assert_allclose(first.rotation, np.eye(3), atol=1e-12)
    assert (first.fx, first.fy, first.cx, first.cy) == (60, 60, 32, 24)
    # parallel lines of sight: placed at the geometric mean of the depths, 4, which becomes 4
    np.testing.assert_allclose(last.centre - first.centre, [2, 0, 0], atol=1e-12)
    np.testing.assert_allclose([c.centre[2] for c in (first, last)], -4, atol=1e-12)


def test_frames_are_decoded_once(folder: Path) -> None:
    before = read_scene(folder)
    stamps = [view.image_path.stat().st_mtime_ns for view in before.views]
    told: list[int] = []
    after = read_scene(folder, lambda done, total: told.append(done))
    assert [view.image_path.stat().st_mtime_ns for view in after.views] == stamps and not told
    for video in folder.glob("*.mp4"):
        video.unlink()
    assert len(read_scene(folder).views) == CAMERAS * FRAMES
    assert before.fingerprint == after.fingerprint


def test_wide_videos_are_halved(folder: Path) -> None:
    for i in range(CAMERAS):
        encode(folder / f"cam{i:02d}.mp4", frames=2, width=2048, height=1536)
    camera = read_scene(folder).views[0].camera
    assert (camera.width, camera.height) == (1024, 768)
    assert camera.fx == pytest.approx(60 * 1024 / WIDTH)


def test_an_interrupted_decoding_leaves_nothing_that_looks_finished(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, written = _decoded.write_png, []

    def interrupt(path: Path, picture: np.ndarray) -> None:
        if len(written) == FRAMES + 2:
            raise KeyboardInterrupt
        written.append(path)
        write(path, picture)

    monkeypatch.setattr(_decoded, "write_png", interrupt)
    with pytest.raises(KeyboardInterrupt):
        read_scene(folder)
    assert sorted(p.name for p in (folder / "cam00").iterdir()) == ["images"]
    assert not list((folder / "cam01").iterdir())
    stale = folder / "cam01" / f".images.{'12' * 16}.part"  # as a killed process leaves it
    stale.mkdir()
    monkeypatch.setattr(_decoded, "write_png", write)
    assert len(read_scene(folder).views) == CAMERAS * FRAMES
    assert not stale.exists()


def test_a_disk_that_is_full_at_any_change_leaves_nothing_that_looks_finished(
    tmp_path: Path,
) -> None:
    for folder, full in full_at_every_change(tmp_path / "scenes", 8, 2):
        for i in range(2):
            encode(folder / f"cam{i:02d}.mp4", frames=2)
        np.save(folder / "poses_bounds.npy", [row(i) for i in range(2)])
        with full:
            try:
                read_scene(folder)
            except DataError as error:
                assert "No space left on device" in str(error)
        assert all(len(list(frames.iterdir())) == 2 for frames in folder.glob("cam*/images"))
        assert not [path for path in folder.rglob("*") if ".part" in path.name]
        if has_failed():
            assert len(read_scene(folder).views) == 4


@pytest.fixture
def read_only(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> set[Path]:
    """The data set on a drive that cannot be written; returns all that is in it."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(_decoded, "can_be_written", lambda path: folder not in path.parents)
    mkdir = Path.mkdir

    def refuse(path: Path, *given: Any, **named: Any) -> None:
        if folder in path.parents:
            raise OSError(30, "Read-only file system", str(path))
        mkdir(path, *given, **named)

    monkeypatch.setattr(Path, "mkdir", refuse)
    return set(folder.rglob("*"))


def test_frames_of_a_folder_that_cannot_be_written_are_kept_in_the_cache(
    folder: Path, read_only: set[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert needs_preparing(folder)
    scene = read_scene(folder)
    assert set(folder.rglob("*")) == read_only
    told = capsys.readouterr().err
    assert "scene cannot be written, so its videos are decoded into" in told
    assert "GSDMSR_FRAMES_DIR would name another folder" in told
    (kept,) = (tmp_path / "cache" / "gsdmsr" / "frames").iterdir()
    assert all(view.image_path.is_relative_to(kept) for view in scene.views)
    stamps = [view.image_path.stat().st_mtime_ns for view in scene.views]
    again = read_scene(folder)
    assert [view.image_path.stat().st_mtime_ns for view in again.views] == stamps
    assert not needs_preparing(folder) and not capsys.readouterr().err


def test_frames_go_where_the_user_says(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(folder.rglob("*"))
    monkeypatch.setenv("GSDMSR_FRAMES_DIR", str(tmp_path / "frames"))
    apart = read_scene(folder)
    assert set(folder.rglob("*")) == before and len(list((tmp_path / "frames").iterdir())) == 1
    encode(folder / "cam01.mp4", frames=FRAMES + 1)  # another video is decoded anew
    read_scene(folder)
    assert len(list((tmp_path / "frames").iterdir())) == 2
    encode(folder / "cam01.mp4")
    monkeypatch.delenv("GSDMSR_FRAMES_DIR")
    inside = read_scene(folder)
    assert all(view.image_path.is_relative_to(folder) for view in inside.views)
    assert inside.pictures == apart.pictures, "a run knows its data wherever its frames lie"
    assert "cam01/images/0003.png" in inside.pictures


def test_a_camera_whose_frames_are_there_is_not_decoded_again(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_scene(folder)
    (folder / "cam02" / "images").rename(tmp_path / "away")
    monkeypatch.setenv("GSDMSR_FRAMES_DIR", str(tmp_path / "frames"))
    views = read_scene(folder).views
    inside = {view.name[:5] for view in views if view.image_path.is_relative_to(folder)}
    assert len(views) == CAMERAS * FRAMES and inside == {"cam00", "cam01"}


def test_where_no_place_can_be_written_it_is_said_what_to_do(
    folder: Path, read_only: set[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    for variable, place in (("GSDMSR_FRAMES_DIR", "file"), ("XDG_CACHE_HOME", "file/cache")):
        monkeypatch.setenv(variable, str(tmp_path / place))
        with pytest.raises(DataError, match=r"cam00: cannot be made: .*; frames of videos") as e:
            read_scene(folder)
        assert "name a folder for them in GSDMSR_FRAMES_DIR, or write a scene" in str(e.value)
        monkeypatch.delenv(variable)


def poses(change: Callable[[np.ndarray], Any]) -> Callable[[Path], Any]:
    def spoil(folder: Path) -> None:
        rows = np.array([row(i) for i in range(CAMERAS)])
        result = change(rows)
        np.save(folder / "poses_bounds.npy", rows if result is None else result)

    return spoil


def truncate(folder: Path) -> None:
    path = folder / "cam01.mp4"
    path.write_bytes(path.read_bytes()[:200])


def stretch(rows: np.ndarray) -> None:
    rows[:, :15] = rows[:, :15] * 2


BAD: dict[str, tuple[Callable[[Path], Any], str]] = {
    "torn poses": (lambda f: (f / "poses_bounds.npy").write_bytes(b"\x93NUMPY"), "is damaged"),
    "other poses": (poses(lambda rows: rows[:, :16]), r"shape \(3, 16\)"),
    "a pose too few": (poses(lambda rows: rows[:2]), "has 2 poses, but there are 3 cameras"),
    "NaN": (poses(lambda rows: rows.__setitem__((0, 3), np.nan)), "holds NaN"),
    "a depth of 0": (poses(lambda rows: rows.__setitem__((0, 15), 0)), "not above 0"),
    "scaled": (poses(stretch), "is not a rigid pose: its rotation is scaled by 2"),
    "another shape": (
        poses(lambda rows: rows.__setitem__((slice(None), 4), 64)), "size is 64 x 64"),
    "a torn video": (truncate, r"cam01\.mp4: no video stream"),
    "another size": (lambda f: encode(f / "cam02.mp4", width=128, height=96), "must have one size"),
    "an empty folder": (lambda f: (f / "cam02" / "images").mkdir(parents=True), "no PNG pictures"),
}  # fmt: skip


@pytest.mark.parametrize(("spoil", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_refused_in_one_line(
    folder: Path, spoil: Callable[[Path], Any], message: str
) -> None:
    spoil(folder)
    assert_refused(folder, message)


def test_other_videos_are_no_cameras(tmp_path: Path) -> None:
    np.save(tmp_path / "poses_bounds.npy", [row(0)])
    encode(tmp_path / "camera.mp4")
    write_picture(tmp_path / "images" / "a.png", noise(4, 4))
    with pytest.raises(DataError, match="has no known layout"):
        read_scene(tmp_path)


def test_two_readers_at_once_decode_every_video_once(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One waits for the other; each then has all frames."""
    real, decoded = _decoded.read_video, list[str]()

    def read(path: Path) -> Any:
        decoded.append(path.name)
        time.sleep(0.05)
        return real(path)

    monkeypatch.setattr(_decoded, "read_video", read)
    with ThreadPoolExecutor(2) as pool:
        scenes = list(pool.map(read_scene, [folder, folder]))
    assert [len(scene.views) for scene in scenes] == [CAMERAS * FRAMES] * 2
    assert sorted(decoded) == [f"cam{i:02d}.mp4" for i in range(CAMERAS)]


def test_a_folder_of_somebody_else_beside_the_frames_is_left_alone(folder: Path) -> None:
    mine = folder / "cam00" / ".images.mine.part"
    mine.mkdir(parents=True)
    read_scene(folder)
    assert mine.is_dir()


def test_a_video_that_has_lost_frames_keeps_its_times_and_is_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second camera has lost the third and fourth of six frames."""
    for name, taken in (("cam00", range(6)), ("cam01", (0, 1, 4, 5)), ("cam02", range(6))):
        pictures = [np.full((48, 64, 3), 40 * i + 20, np.uint8) for i in taken]
        ticks = [i * TICKS // 30 for i in taken]
        write_video(folder / f"{name}.mp4", pictures, "mpeg4", ticks=ticks)
    scene = read_scene(folder)
    assert [view.time for view in scene.views[6:10]] == [0.0, 0.2, 0.8, 1.0]
    assert scene.views[8].name == "cam01_0004" and len(scene.views) == 16
    for view in scene.views:
        assert read_image(view.image_path).mean() == pytest.approx(200 * view.time + 20, abs=6)
    told = "scene: pictures are missing: cam01 has none at 2 of 6 moments, such as the 3."
    assert told in capsys.readouterr().err


def test_a_picture_that_is_missing_shifts_no_others(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {view.name: view for view in read_scene(folder).views}
    assert not capsys.readouterr().err
    for camera, name in (("cam01", "0000.png"), ("cam02", "0003.png")):
        (folder / camera / "images" / name).unlink()
    after = read_scene(folder).views
    assert {view.name: view.time for view in after} == {
        name: view.time for name, view in before.items() if name not in ("cam01_0000", "cam02_0003")
    }
    for view in after:
        np.testing.assert_array_equal(view.camera.centre, before[view.name].camera.centre)
    told = capsys.readouterr().err
    assert "cam01 has none at 1 of 5 moments, such as the 1.; cam02 has none at 1 of 5" in told


def test_broken_videos_among_many_are_named_and_the_others_decoded(folder: Path) -> None:
    for name in ("cam00.mp4", "cam02.mp4"):
        (folder / name).write_bytes((folder / name).read_bytes()[:200])
    with pytest.raises(DataError, match=r"cam00\.mp4: no video stream") as caught:
        read_scene(folder)
    text = str(caught.value)
    assert text.endswith("so are 1 more, " + str(folder / "cam02.mp4") + "; frames of the other "
                         "videos are kept")  # fmt: skip
    assert len(list((folder / "cam01" / "images").iterdir())) == FRAMES


@given(st.lists(st.integers(1, 5), min_size=1, max_size=60), st.floats(0.001, 1))
def test_frames_are_numbered_by_their_times(gaps: list[int], step: float) -> None:
    most = [1, 1, *gaps, *[1] * len(gaps)]  # so that the usual gap is one step
    times = np.cumsum([0, *most]) * step
    assert _decoded.numbers_of(times.tolist()) == np.cumsum([0, *most]).tolist()


def test_uneven_frames_are_numbered_in_their_order() -> None:
    assert _decoded.numbers_of([0.0, 0.1, 0.25, 0.35]) == [0, 1, 2, 3]
    assert _decoded.numbers_of([0.0, 1.0, 1.01, 2.0]) == [0, 1, 2, 3]
    assert _decoded.numbers_of([0.0]) == [0] and _decoded.numbers_of([]) == []
    drifting = [round(i / 30, 3) for i in range(2000)]  # as WebM counts
    assert _decoded.numbers_of(drifting) == list(range(2000))
