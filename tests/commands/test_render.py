"""Films of a run: every output, going on after a break, and what cannot be drawn."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from training_checks import begun_run

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.filming import buffers as drawn_buffers
from gsdmsr_cli.filming import draw_film
from gsdmsr_cli.runs.run import open_run
from gsdmsr_cli.scene.imaging import image_size, read_exr, read_image
from gsdmsr_cli.scene.native import load_av

Render = Callable[..., int]

FEW = ("splats.count=200", "splats.start=box", "splats.opacity=0.5", "motion={name: static}")


@pytest.fixture(scope="module")
def run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that has made no step."""
    return begun_run(tiny_scene, tmp_path_factory.mktemp("render") / "run", FEW).root


@pytest.fixture
def render(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Render:
    """``gsdmsr render RUN --out`` a folder of this test."""

    def call(line: str, *more: object) -> int:
        named = line.split() if not line.startswith("--") else [run, *line.split()]
        words = ["gsdmsr", "render", *named, *more]
        if "--out" not in words:
            words += ["--out", tmp_path / "out"]
        monkeypatch.setattr(sys, "argv", [str(word) for word in words])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code

    threads = torch.get_num_threads()
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)
    yield call
    torch.set_num_threads(threads)


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    return err


def stamps(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}


def frames_drawn(capsys: pytest.CaptureFixture[str]) -> int:
    match = re.search(r"^drew (\d+) frames", capsys.readouterr().out, re.MULTILINE)
    return int(match[1]) if match else 0


def test_every_output_has_its_files(render: Render, tmp_path: Path, capsys: Any) -> None:
    assert render("--path test --output error,flow,alpha,depth,rgb") == 0
    told = capsys.readouterr().out
    out = tmp_path / "out"
    for name, count in {"": 4, "-depth": 4, "-alpha": 4, "-flow": 3, "-error": 4}.items():
        pngs = sorted((out / f"test{name}").glob("*.png"))
        assert [path.name for path in pngs] == [f"{i:04d}.png" for i in range(count)]
        assert all(image_size(path) == (48, 48) for path in pngs)
        assert f"wrote {out / f'test{name}.webm'} and {count} pictures beside it" in told
        note = json.loads((out / f"test{name}.film.json").read_text())
        assert (note["frames"], note["size"], note["fps"]) == (count, [48, 48], 10)
    depth, channels = read_exr(out / "test-depth" / "0002.exr")
    assert channels == ("Z",) and depth.shape == (48, 48, 1)
    assert 2 < depth[np.isfinite(depth)].mean() < 6  # cameras stand 4 away
    flow, channels = read_exr(out / "test-flow" / "0002.exr")
    assert channels == ("u", "v") and flow.shape == (48, 48, 2) and np.abs(flow).max() > 1
    assert re.search(r"^drew 4 frames of 48 x 48 px: .* s, \d+ % of it drawing$", told, re.M)


@pytest.mark.parametrize("path", ["orbit", "spiral"])
def test_cameras_go_round_what_was_reconstructed(
    tiny_scene: Path, render: Render, tmp_path: Path, path: str
) -> None:
    """An object off the world's origin, which all cameras of the data face, is in the middle."""
    run = begun_run(tiny_scene, tmp_path / "run", FEW)
    checkpoint = run.load()
    means = checkpoint.tensors["splats.means"]
    means.copy_(0.2 * means + torch.tensor([0.3, -0.2, 0.5]))
    checkpoint.tensors["splats.log_scales"].fill_(-3.5)
    run.save(checkpoint)
    line = f"{run.root} --path {path} --frames 8 --output alpha --video none"
    assert render(line) == 0
    rows, columns = np.mgrid[:48, :48] + 0.5
    for file in sorted((tmp_path / "out" / f"{path}-alpha").glob("*.png")):
        alpha = read_image(file)[..., 0].astype(np.float64)
        assert alpha.max() > 100
        centre = [(alpha * at).sum() / alpha.sum() for at in (columns, rows)]
        assert centre == pytest.approx([24, 24], abs=1.5)


def test_a_broken_film_is_gone_on_with(
    render: Render, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    """The frames that are there stay as they are, and the end is that of a film in one go."""
    line, whole, broken = (
        "--path orbit --frames 8 --output rgb,depth",
        tmp_path / "a",
        tmp_path / "b",
    )
    assert render(line, "--out", whole) == 0

    draw, drawn = drawn_buffers.BufferRenderer.draw, []

    def fail_at_sixth(self: Any, shot: Any, following: Any) -> Any:
        drawn.append(shot)
        if len(drawn) == 7:  # the first warms up
            time.sleep(0.5)  # so that those before are written
            raise KeyboardInterrupt
        return draw(self, shot, following)

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(draw_film.BufferRenderer, "draw", fail_at_sixth)
        # which draws as well
        patch.setattr(
            "gsdmsr_cli.commands.render.find_colour_range", lambda *_: colour_range_of(whole)
        )
        assert render(line, "--out", broken) == 130
    there = {name: stamps(broken / name) for name in ("orbit", "orbit-depth")}
    assert len(there["orbit"]) == 5 and not list(tmp_path.rglob("*.part*"))
    assert not list(broken.glob("*.webm"))
    capsys.readouterr()
    assert render(line, "--out", broken) == 0
    assert frames_drawn(capsys) == 8 - len(there["orbit"])
    for name, before in there.items():
        after = stamps(broken / name)
        assert {key: after[key] for key in before} == before
        for path in (whole / name).iterdir():
            other = broken / name / path.name
            if path.suffix == ".exr":  # which also holds when it was written
                np.testing.assert_array_equal(read_exr(path)[0], read_exr(other)[0])
            else:
                assert path.read_bytes() == other.read_bytes()
        video = f"{name}.webm"
        assert (whole / video).stat().st_size == (broken / video).stat().st_size
    assert render(line, "--out", broken) == 0
    assert "nothing to draw, 8 were there already" in capsys.readouterr().out


def colour_range_of(folder: Path) -> Any:
    from gsdmsr_cli.filming.outputs import ColourRange

    note = json.loads((folder / "orbit-depth.film.json").read_text())
    return ColourRange(note["near"], note["far"])


@pytest.mark.parametrize(
    ("more", "drawn"),
    [
        ("", 0),
        ("--overwrite", 5),
        ("--size 32x32", 5),
        ("--supersample 2", 5),
        ("--time 0.5", 5),
        ("--frames 4", 4),
        ("--fps 12", 0),
        ("--video none", 0),
        ("--output rgb,alpha", 5),
    ],
)
def test_only_frames_that_show_the_same_are_kept(
    render: Render, tmp_path: Path, capsys: Any, more: str, drawn: int
) -> None:
    frames = "" if "--frames" in more else "--frames 5"
    assert render("--path orbit --frames 5") == 0
    before = stamps(tmp_path / "out" / "orbit")
    capsys.readouterr()
    assert render(f"--path orbit {frames} {more}") == 0
    assert frames_drawn(capsys) == drawn
    after = stamps(tmp_path / "out" / "orbit")
    kept = not drawn or "alpha" in more
    assert all((after[name] == before[name]) == kept for name in after)
    assert len(after) == (4 if "--frames" in more else 5)


def test_frames_of_another_checkpoint_are_drawn_anew(
    run: Path, render: Render, tmp_path: Path, capsys: Any
) -> None:
    assert render("--path orbit --frames 3") == 0
    capsys.readouterr()
    opened = open_run(run)
    before = opened.checkpoint_path.read_bytes()
    opened.save(replace(opened.load(), step=1))
    assert render("--path orbit --frames 3") == 0
    assert frames_drawn(capsys) == 3
    opened.checkpoint_path.write_bytes(before)


def test_what_a_killed_film_has_left_unfinished_is_removed(render: Render, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "orbit").mkdir(parents=True)
    left = [unfinished(out / name) for name in ("orbit.film.json", "orbit.webm", "orbit/0001.png")]
    assert render("--path orbit --frames 2") == 0
    assert [path for path in left if path.exists()] == []


def unfinished(path: Path) -> Path:
    """Make what a killed process leaves of a file that it was writing."""
    name = hashlib.sha256(path.name.encode()).hexdigest()[:16]
    left = path.with_name(f".gsdmsr-{name}{0:016x}.part{path.suffix}")
    left.touch()
    return left


def test_a_damaged_frame_is_drawn_again(render: Render, tmp_path: Path, capsys: Any) -> None:
    assert render("--path orbit --frames 3") == 0
    path = tmp_path / "out" / "orbit" / "0001.png"
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    capsys.readouterr()
    assert render("--path orbit --frames 3") == 0
    assert frames_drawn(capsys) == 1 and path.read_bytes() == whole


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C of another process")
def test_ctrl_c_leaves_whole_frames_and_nothing_else(run: Path, tmp_path: Path) -> None:
    line = ["render", run, "--path", "orbit", "--frames", "5000", "--out", tmp_path / "out"]
    # a process in the background of a shell script begins with SIGINT ignored
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from gsdmsr_cli.cli.main import main; main()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, line)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while not (tmp_path / "out" / "orbit" / "0009.png").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"orbit", "orbit.film.json"}
    frames = sorted((tmp_path / "out" / "orbit").iterdir())
    assert len(frames) < 5000
    for frame in frames:
        assert frame.suffix == ".png" and read_image(frame).shape == (48, 48, 3)


@pytest.mark.parametrize(
    ("line", "size"),
    [("--size 32x20", (32, 20)), ("--scale 0.5", (24, 24)), ("--scale 1.5", (72, 72))],
)
def test_sizes(render: Render, tmp_path: Path, line: str, size: tuple[int, int]) -> None:
    assert render(f"--path still --view test/r_000 --frames 1 --video none {line}") == 0
    assert image_size(tmp_path / "out" / "still" / "0000.png") == size
    assert not (tmp_path / "out" / "still.webm").exists()


def test_another_proportion_shows_more_and_stretches_nothing(
    render: Render, tmp_path: Path
) -> None:
    line = "--path still --view test/r_000 --frames 1 --video none"
    assert render(line, "--out", tmp_path / "a") == 0
    assert render(f"{line} --size 96x48", "--out", tmp_path / "b") == 0
    square, wide = (read_image(tmp_path / name / "still" / "0000.png") for name in "ab")
    # engines hold the shapes of splats far outside a picture, so those beside it may differ a bit
    difference = np.abs(wide[:, 24:72].astype(int) - square)
    assert difference.max() <= 2 and difference.mean() < 0.01 < square.std()


BAD = {
    "unknown path": ("--path orbti", 2, "unknown path 'orbti'; did you mean 'orbit'"),
    "frames of views": ("--path test --frames 3", 2, "--frames is not for --path test"),
    "error of what nobody took": ("--path orbit --output error", 2, "compares with true pictures"),
    "error of another moment": ("--path test --time 0.11 --output error", 2, "without --time"),
    "error stretched": ("--path test --output error --size 40x20", 2, "48 x 48 px; found 40 x 20"),
    "error enlarged": ("--path test --output error --scale 2", 2, "found 96 x 96"),
    "too large": ("--path orbit --scale 300 --supersample 2", 2, "allowed: 1 to 8192 px a side"),
    "too small": ("--path orbit --scale 0.001", 2, "pictures of 0 x 0 px"),
    "no file of keyframes": ("--path none.json", 3, r"none\.json: cannot be read: No such file"),
    "no view": ("--path still --view test/r_9", 2, "no view is called 'test/r_9'"),
    "no encoder": ("--path orbit --video mp4", 2, "needs the encoder libx264"),
}


@pytest.mark.parametrize(("line", "code", "message"), BAD.values(), ids=BAD)
def test_what_cannot_be_drawn_is_told_before_anything_is_written(
    render: Render,
    tmp_path: Path,
    capsys: Any,
    monkeypatch: Any,
    line: str,
    code: int,
    message: str,
) -> None:
    monkeypatch.setattr(load_av(), "codecs_available", {"libvpx"})
    assert render(line) == code
    assert re.search(message, one_line(capsys))
    assert not (tmp_path / "out").exists()


def test_a_malformed_file_of_keyframes_is_bad_data(
    render: Render, tmp_path: Path, capsys: Any
) -> None:
    path = tmp_path / "tour.json"
    path.write_text('{"keyframes": [{"time": 2, "view": "test/r_000"}, {}]}')
    assert render("--path", path) == 3
    assert f"{path}: keyframes[0]: time is 2.0; allowed: 0 to 1" in one_line(capsys)
    assert not (tmp_path / "out").exists()


def test_a_film_of_keyframes_is_called_like_its_file(
    render: Render, tmp_path: Path, capsys: Any
) -> None:
    path = tmp_path / "out" / "tour.json"
    path.parent.mkdir()
    keys = [{"time": 0, "view": "test/r_000"}, {"time": 1, "view": "test/r_001"}]
    path.write_text(json.dumps({"keyframes": keys, "frames": 3}))
    before = path.read_bytes()
    assert render("--path", path) == 0
    assert len(list((tmp_path / "out" / "tour").iterdir())) == 3
    assert path.read_bytes() == before and (tmp_path / "out" / "tour.webm").is_file()


def test_a_run_without_a_checkpoint_is_bad_data(
    run: Path, render: Render, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "run.json").write_bytes((run / "run.json").read_bytes())
    monkeypatch.setattr(sys, "argv", ["gsdmsr", "render", str(bare)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3
    assert "the run has no checkpoint yet" in one_line(capsys)


@pytest.mark.parametrize("place", ["out", "out/orbit", "out/orbit.film.json"])
def test_a_folder_that_cannot_be_written_is_told_before_drawing(
    render: Render, tmp_path: Path, capsys: Any, monkeypatch: Any, place: str
) -> None:
    monkeypatch.setattr("gsdmsr_cli.commands.render.draw_film", lambda *_: pytest.fail("it draws"))
    blocked = tmp_path / place
    blocked.parent.mkdir(exist_ok=True)
    blocked.write_text('{"tour": "of somebody else"}')
    assert render("--path orbit --frames 2") == 3
    assert str(tmp_path / "out") in one_line(capsys)
    assert blocked.read_text() == '{"tour": "of somebody else"}'


@pytest.mark.parametrize("name", ["orbit/0007.png", "orbit/0000.png", "orbit.mp4"])
def test_files_of_somebody_else_are_refused(
    render: Render, tmp_path: Path, capsys: Any, name: str
) -> None:
    path = tmp_path / "out" / name
    path.parent.mkdir(parents=True)
    path.touch()
    assert render("--path orbit --frames 2") == 3
    message = f"1 pictures or videos already that are not known to be of gsdmsr, {path.name} the"
    assert message in one_line(capsys)
    assert path.stat().st_size == 0


def test_the_runs_own_folder_is_cleared(run: Path, monkeypatch: Any) -> None:
    path = run / "render" / "orbit" / "0007.png"
    path.parent.mkdir(parents=True)
    path.touch()
    monkeypatch.setattr(
        sys, "argv", ["gsdmsr", "render", str(run), *["--path", "orbit", "--frames", "2"]]
    )
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert sorted(stamps(path.parent)) == ["0000.png", "0001.png"]


def test_a_full_disk_ends_the_film_in_one_line(
    render: Render, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    def full(self: Path, data: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    assert render("--path orbit --frames 50") == 3
    assert "No space left on device" in one_line(capsys)
    assert not list(tmp_path.rglob("*.png")) and not list(tmp_path.rglob("*.webm"))
