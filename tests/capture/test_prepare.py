"""From pictures or a film of a room, drawn under known cameras, to a scene folder and back."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import room

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.imaging import read_image

FRAMES = 14


def prepare(*arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "gsdmsr_cli", "prepare", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True)


@pytest.fixture(scope="module")
def shots() -> room.Shots:
    return room.film(room.walk(FRAMES))


@pytest.fixture(scope="module")
def pictures(shots: room.Shots, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return room.write_pictures(tmp_path_factory.mktemp("room") / "pictures", shots)


@pytest.fixture(scope="module")
def scene(pictures: Path) -> Path:
    out = pictures.parent / "scene"
    ended = prepare(pictures, "--out", out)
    assert ended.returncode == 0, ended.stderr
    return out


def test_cameras_are_where_the_pictures_were_drawn(scene: Path, shots: room.Shots) -> None:
    views = read_scene(scene).views
    assert [view.name for view in views] == [f"{i:05d}" for i in range(FRAMES)]
    centres = np.stack([view.camera.centre for view in views])
    assert room.trajectory_error(centres, shots.poses[:, :3, 3]) < 0.003
    for view in views:
        assert view.camera.fx == pytest.approx(room.FOCAL * view.camera.width, rel=0.02)


def test_the_world_is_upright_and_normalized(scene: Path, shots: room.Shots) -> None:
    read = read_scene(scene)
    up = np.mean([-view.camera.rotation[1] for view in read.views], axis=0)
    assert up / np.linalg.norm(up) == pytest.approx([0, 0, 1], abs=1e-6)
    note = json.loads((scene / "scene.json").read_text())
    assert read.bound == note["bound"] and note["gsdmsr"] == 1
    inside = (np.abs(read.points) <= read.bound).all(axis=1)
    assert inside.mean() > 0.9 and len(read.points) > 300


def test_points_lie_where_their_colours_are_seen(scene: Path) -> None:
    read = read_scene(scene)
    view = read.views[5]
    camera = view.camera
    local = read.points @ camera.rotation.T + camera.translation
    u = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    v = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    inside = (u > 1) & (u < camera.width - 1) & (v > 1) & (v < camera.height - 1)
    picture = read_image(view.image_path)[v[inside].astype(int), u[inside].astype(int)] / 255
    off = np.abs(picture - read.colours[inside]).mean(axis=1)
    assert inside.sum() > 200 and np.median(off) < 0.05


def test_splits_and_times(scene: Path) -> None:
    views = read_scene(scene).views
    assert [view.time for view in views] == pytest.approx([i / 13 for i in range(FRAMES)])
    tests = [i for i, view in enumerate(views) if view.split == "test"]
    assert tests == [4, 12]


def test_the_report_says_how_good_the_cameras_are(scene: Path) -> None:
    quality = json.loads((scene / "scene.json").read_text())["quality"]
    assert quality["frames"]["registered"] == FRAMES and not quality["frames"]["dropped"]
    assert quality["reprojection_px"] < 0.5 and quality["parallax_deg"] > 15
    assert quality["moving_matches"] < 0.05 and quality["warnings"] == []
    assert quality["turning_matches"] < 0.3
    page = (scene / "report.html").read_text()
    assert page.count("<svg") == 2 and "prefers-color-scheme:dark" in page


def test_nothing_else_is_left_behind(scene: Path, pictures: Path) -> None:
    names = {path.name for path in scene.iterdir()}
    files = {"images", "transforms.json", "points.ply", "scene.json", "report.html"}
    assert names == files | {"timings.json"}
    assert not list(scene.rglob(".*")) and not list(pictures.parent.glob("*.stages"))


def test_the_same_pictures_and_seed_give_the_same_bytes(scene: Path, pictures: Path) -> None:
    again = pictures.parent / "again"
    assert prepare(pictures, "--out", again).returncode == 0
    files = sorted(path.relative_to(scene) for path in scene.rglob("*") if path.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    for name in files:
        if name.name != "timings.json":
            assert (scene / name).read_bytes() == (again / name).read_bytes(), name


def test_an_earlier_scene_is_replaced_only_if_asked(
    scene: Path, pictures: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").touch()
    ended = prepare(pictures, "--out", scene)
    assert ended.returncode == 2 and "--overwrite" in ended.stderr
    ended = prepare(pictures, "--out", tmp_path / "mine", "--overwrite")
    assert ended.returncode == 2 and "no scene of prepare's" in ended.stderr
    assert len(list((tmp_path / "mine").iterdir())) == 1


def test_a_film_gives_a_scene_in_seconds(shots: room.Shots, tmp_path: Path) -> None:
    film = room.write_film(tmp_path / "film.mp4", shots, fps=5)
    ended = prepare(film, "--out", tmp_path / "scene", "--mapping", "incremental", "--json")
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert told["duration"] == pytest.approx((FRAMES - 1) / 5)
    read = read_scene(tmp_path / "scene")
    centres = np.stack([view.camera.centre for view in read.views])
    assert room.trajectory_error(centres, shots.poses[:, :3, 3]) < 0.01


def test_pictures_of_two_sizes_are_refused(pictures: Path, tmp_path: Path) -> None:
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for i, path in enumerate(sorted(pictures.iterdir())):
        picture = cv2.imread(str(path))
        cv2.imwrite(str(mixed / path.name), picture[:, :300] if i == 9 else picture)
    ended = prepare(mixed, "--out", tmp_path / "scene")
    assert ended.returncode == 3 and "shot009.png is 300 x 240 px" in ended.stderr
    assert not (tmp_path / "scene").exists()


def processes_of(folder: Path) -> list[str]:
    """Return the command lines of living processes that name the folder."""
    lines = []
    for process in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(process.read_bytes().replace(b"\0", b" ").decode(errors="replace"))
        except OSError:  # it has just ended
            continue
    return [line for line in lines if str(folder) in line]


@pytest.mark.skipif(sys.platform != "linux", reason="looks for processes in /proc")
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL], ids=["ctrl-c", "kill"])
def test_an_interrupted_run_leaves_no_scene_and_the_next_goes_on(
    scene: Path, pictures: Path, tmp_path: Path, how: signal.Signals
) -> None:
    out, stages = tmp_path / "scene", tmp_path / "scene.stages"
    line = [sys.executable, "-m", "gsdmsr_cli", "prepare", str(pictures), "--out", str(out)]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 120
        while not any("capture.colmap" in line for line in processes_of(stages)):
            assert process.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(how)
        process.wait(timeout=10)
        said = process.stderr.read() if process.stderr else ""
    assert process.returncode == (130 if how == signal.SIGINT else -signal.SIGKILL)
    assert ("the same command goes on" in said) == (how == signal.SIGINT)
    while processes_of(stages):  # the child of a killed process notices
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert not out.exists()
    ended = prepare(pictures, "--out", out, "--json")
    assert ended.returncode == 0, ended.stderr
    assert "finding features" not in json.loads(ended.stdout)["seconds"]
    assert "matching frames" in json.loads(ended.stdout)["seconds"]
    for name in ("transforms.json", "scene.json", "points.ply"):
        assert (out / name).read_bytes() == (scene / name).read_bytes()


@pytest.mark.skipif(os.name == "nt", reason="needs a limit on the size of files")
@pytest.mark.parametrize("limit", [20_000, 400_000], ids=["pictures", "database"])
def test_a_full_disk_is_told_and_leaves_no_scene(
    pictures: Path, tmp_path: Path, limit: int
) -> None:
    import resource

    line = [sys.executable, "-m", "gsdmsr_cli", "prepare", str(pictures)]
    ended = subprocess.run(
        [*line, "--out", str(tmp_path / "scene")], capture_output=True, text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )  # fmt: skip
    assert ended.returncode == 3, ended.stderr
    assert "disk full?" in ended.stderr or "free space" in ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("error:") and not (tmp_path / "scene").exists()
    assert not list((tmp_path / "scene.stages").glob(".*.part"))


def test_a_camera_that_only_turns_is_told_of(tmp_path: Path) -> None:
    """Its cameras are made up and fit to a tenth of a pixel."""
    place = np.array([0.0, -1.2, 0.1])
    ahead = [[np.sin(angle), np.cos(angle), -0.1] for angle in np.linspace(-0.8, 0.8, FRAMES)]
    shots = room.film(np.stack([room.look_at(place, place + d) for d in ahead]))
    pictures = room.write_pictures(tmp_path / "pictures", shots)
    ended = prepare(pictures, "--out", tmp_path / "scene")
    assert ended.returncode == 0, ended.stderr
    quality = json.loads((tmp_path / "scene" / "scene.json").read_text())["quality"]
    assert quality["turning_matches"] > 0.99 and quality["reprojection_px"] < 0.2
    assert any("only turns" in warning for warning in quality["warnings"])


def noisy(pictures: np.ndarray) -> room.Shots:
    rng = np.random.default_rng(0)
    grainy = (pictures + rng.normal(0, 3, pictures.shape)).clip(0, 255).astype(np.uint8)
    return room.Shots(grainy, np.zeros((len(pictures), 4, 4)), np.zeros(len(pictures)))


def standing_still() -> np.ndarray:
    return np.stack([room.draw(room.walk(3)[1], 240, 180)[0]] * 10)


def unlike_one_another() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (10, 180, 240, 3), dtype=np.uint8)


def without_texture() -> np.ndarray:
    return np.full((10, 180, 240, 3), 99, np.uint8)


def two_halves() -> np.ndarray:
    back = [
        room.look_at(np.array([x, 1.2, 0.1]), np.array([x, -2.0, 0.0]))
        for x in np.linspace(-1, 1, 8)
    ]
    there = room.film(room.walk(8), 240, 180).pictures
    return np.concatenate([there, room.film(np.stack(back), 240, 180).pictures])


@pytest.mark.parametrize(
    ("pictures_of", "message"),
    [
        (standing_still, "the camera does not move"),
        (unlike_one_another, "the frames do not match: only 0 pairs of 10 frames"),
        (without_texture, "the frames show too little"),
        (two_halves, "of 16 frames have a camera in one world"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_captures_without_cameras_are_told_why(
    tmp_path: Path, pictures_of: Callable[[], np.ndarray], message: str
) -> None:
    pictures = room.write_pictures(tmp_path / "pictures", noisy(pictures_of()))
    ended = prepare(pictures, "--out", tmp_path / "scene")
    assert ended.returncode == 3 and message in ended.stderr, ended.stderr
    assert ended.stderr.splitlines()[-1].startswith("error:") and not (tmp_path / "scene").exists()
