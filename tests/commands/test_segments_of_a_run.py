"""gsdmsr train --segments: what it leaves, how it is read, and what becomes of an early end."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rigs import write_rig
from served_pages import get, view

from gsdmsr_cli.commands import _segments
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.model.joined import Joined
from gsdmsr_cli.moving.container import from_bytes
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.runs.run import open_run, open_with_model
from gsdmsr_cli.runs.segments import folder_of, static_of
from gsdmsr_cli.training.loop import validation_view

Gsdmsr = Callable[..., int]

MOMENTS, STEPS = 8, 24
SETTINGS = [
    f"--set={option}"
    for option in (
        f"training.steps={STEPS}", "splats.count=120", "splats.start=box", "density.until=0",
        "density.cap=160", "training.threads=1",
        "motion.count=24", "data.background=white", "segments.overlap=0.25",
    )
]  # fmt: skip
GIVEN = "--preset", "dnerf", "--segments", "2", *SETTINGS


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rig(tmp_path_factory.mktemp("rig"), moments=MOMENTS, span=0.2)


@pytest.fixture(scope="module")
def trained(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two segments that have come to their ends."""
    out = tmp_path_factory.mktemp("trained") / "run"
    words = ["train", "--data", str(rig), "--out", str(out), *GIVEN]
    subprocess.run([sys.executable, "-m", "gsdmsr_cli", *words], check=True)
    return out


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of it, elsewhere."""
    shutil.copytree(trained, tmp_path / "run")
    return tmp_path / "run"


def tensors_of(root: Path) -> dict[str, torch.Tensor]:
    return open_run(root).load().tensors


def assert_same(one: Path, other: Path) -> None:
    """Hold the models of two runs, and of their segments, to the same bits."""
    folders = [lambda root: root, static_of, *(lambda r, i=i: folder_of(r, i) for i in (0, 1))]
    for folder in folders:
        first, second = tensors_of(folder(one)), tensors_of(folder(other))
        assert first.keys() == second.keys()
        assert all(torch.equal(first[name], second[name]) for name in first)


def test_segments_are_trained_and_joined(
    run: Path, rig: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    still, first, second = open_run(static_of(run)), *(open_run(folder_of(run, i)) for i in (0, 1))
    assert still.load().step == STEPS // 4
    stood = still.load_model()[0]
    start, end = (stood.at(stood.instant(time)).splats.means for time in (0.0, 1.0))
    assert torch.equal(start, end)
    assert (first.preset.data.between, second.preset.data.between) == (
        pytest.approx((0, 1 / 1.75)), pytest.approx((0.75 / 1.75, 1)),
    )  # fmt: skip
    joined = open_run(run)
    model, checkpoint = joined.load_model()
    assert isinstance(model, Joined)
    assert checkpoint.progress == 1
    assert checkpoint.step == joined.account(checkpoint.step)["steps"] == 2 * STEPS + STEPS // 4
    view = read_scene(rig).split("train")[0]
    for segment, time_in_all, within in ((first, 0.0, 0.0), (second, 1.0, 1.0)):
        alone = segment.load_model()[0]
        engine, behind = best_engine("cpu"), torch.ones(3)
        with torch.no_grad():
            own = draw(alone, view.camera, within, engine, behind).rgb
            found = draw(model, view.camera, time_in_all, engine, behind).rgb
        assert torch.equal(own, found)
    capsys.readouterr()
    assert gsdmsr("eval", run, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["frames"]) == MOMENTS
    stored = document["storage"]
    assert stored["splats_bytes"] > 0 and stored["motion_bytes"] > 0
    assert stored["training_state_bytes"] < 100
    assert document["training"]["segments"] == 2
    assert gsdmsr("info", run) == 0


def test_a_segment_is_a_run_like_any_other(run: Path, gsdmsr: Gsdmsr) -> None:
    one = folder_of(run, 1)
    assert gsdmsr("eval", one) == 0
    inside = [time for time in read_scene(open_run(run).data).train_times if time >= 0.75 / 1.75]
    document = json.loads((one / "eval" / "metrics.json").read_text())
    assert len(document["frames"]) == len(inside)
    assert gsdmsr("export", one, "--format", "html", "--out", one / "page.html") == 0


def test_its_splats_are_exported_moment_by_moment_and_as_one_file_that_plays(
    run: Path, rig: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gsdmsr("export", run, "--format", "ply", "--time", 0.5, "--out", run / "a.ply") == 0
    file = run.parent / "joined.dsplat"
    assert gsdmsr("export", run, "--format", "moving", "--out", file) == 0
    scores = []
    for one in (run, file):
        capsys.readouterr()
        assert gsdmsr("eval", one, "--data", rig, "--json") == 0
        document = json.loads(capsys.readouterr().out)
        scores.append(document["aggregate"]["psnr"])
    assert scores[1] == pytest.approx(scores[0], abs=0.15)
    assert gsdmsr("export", run, "--format", "compact", "--out", run / "packed") == 2
    assert "export the runs in its folder segments one by one" in capsys.readouterr().err


def test_all_of_them_are_looked_at_together(
    run: Path, rig: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    with view(run) as address:
        header, _ = from_bytes(get(address, "scene.dsplat"))
        own = [len(open_run(folder_of(run, i)).load_model()[0].splats) for i in (0, 1)]
        assert max(own) < header["splats"] <= sum(own)
        shown = cv2.imdecode(np.frombuffer(get(address, "drawn.png"), np.uint8), -1)[..., ::-1]
    held_out, (_, model, _) = validation_view(read_scene(rig)), open_with_model(run)
    white = torch.ones(3)
    drawn = draw(model, held_out.camera, held_out.time, best_engine("cpu"), white).rgb.numpy()
    assert np.abs(shown / 255 - drawn.clip(0, 1)).mean() < 0.01 < np.abs(1 - drawn).mean() / 5
    open_run(run).checkpoint_path.unlink()
    assert gsdmsr("view", run) == 3
    assert "not all of its 2 segments are trained" in capsys.readouterr().err


def test_side_by_side_they_become_the_same(
    run: Path, rig: Path, tmp_path: Path, gsdmsr: Gsdmsr
) -> None:
    other = tmp_path / "other"
    assert gsdmsr("train", "--data", rig, "--out", other, *GIVEN, "--jobs", 2) == 0
    assert_same(run, other)
    assert (folder_of(other, 0).with_name("000.log")).is_file()


def test_on_workers_of_ray_they_become_the_same(
    run: Path, rig: Path, tmp_path: Path, gsdmsr: Gsdmsr
) -> None:
    pytest.importorskip("ray", reason="pip install 'gsdmsr[ray]'")
    other = tmp_path / "other"
    words = "train", "--data", rig, "--out", other, *GIVEN
    assert gsdmsr(*words, "--workers", 2) == 0
    assert_same(run, other)


def test_what_is_finished_is_not_done_again(
    run: Path, rig: Path, gsdmsr: Gsdmsr, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tensors_of(run)
    lines: list[tuple[str, ...]] = []
    monkeypatch.setattr(_segments, "call", lambda *line: lines.append(line))
    assert gsdmsr("train", "--data", rig, "--out", run, "--resume") == 0
    assert not lines
    assert all(torch.equal(tensor, before[name]) for name, tensor in tensors_of(run).items())


def test_a_longer_length_goes_on_in_all(run: Path, rig: Path, gsdmsr: Gsdmsr) -> None:
    longer = "--steps", STEPS + 6
    assert gsdmsr("train", "--data", rig, "--out", run, "--resume", *longer) == 0
    assert [open_run(folder_of(run, i)).load().step for i in (0, 1)] == [STEPS + 6] * 2
    assert open_run(static_of(run)).load().step == round((STEPS + 6) / 4)
    assert gsdmsr("train", "--data", rig, "--out", run, "--resume", "--set=motion.count=9") == 2


def test_killed_it_goes_on_and_ends_the_same(
    run: Path, rig: Path, tmp_path: Path, gsdmsr: Gsdmsr, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "other"
    command = ["train", "--data", str(rig), "--out", str(out), *GIVEN]
    process = subprocess.Popen([sys.executable, "-m", "gsdmsr_cli", *command])
    one = folder_of(out, 1) / "checkpoint.safetensors"
    deadline = time.monotonic() + 120
    while not one.is_file() and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130
    if not (out / "checkpoint.safetensors").is_file():
        assert gsdmsr("eval", out) == 3
        assert "not all of its 2 segments are trained" in capfd.readouterr().err
    assert gsdmsr("train", "--data", rig, "--out", out, "--resume") == 0
    assert_same(run, out)


def test_a_stretch_of_the_capture_is_cut(rig: Path, tmp_path: Path, gsdmsr: Gsdmsr) -> None:
    out = tmp_path / "run"
    part = "--set=data.between=[0.0, 0.6]"
    assert gsdmsr("train", "--data", rig, "--out", out, *GIVEN, part) == 0
    assert open_run(folder_of(out, 1)).preset.data.between == pytest.approx((0.45 / 1.75, 0.6))
    assert gsdmsr("eval", out) == 0
    document = json.loads((out / "eval" / "metrics.json").read_text())
    assert [frame["time"] for frame in document["frames"]][-1] == pytest.approx(4 / 7 / 0.6)


def test_a_new_training_leaves_nothing_of_an_earlier_one(
    run: Path, rig: Path, gsdmsr: Gsdmsr
) -> None:
    whole = "--preset", "dnerf", "--segments", "1", *SETTINGS, "--overwrite"
    assert gsdmsr("train", "--data", rig, "--out", run, *whole) == 0
    assert not (run / "segments").exists()
    assert not isinstance(open_with_model(run)[1], Joined)


def test_a_dry_run_says_what_would_be_done(
    rig: Path, tmp_path: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert gsdmsr("train", "--data", rig, "--out", out, *GIVEN, "--dry-run", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [segment["moments"] for segment in document["segments"]] == [5, 5]
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--segments", 5), "allowed: fewer, since from"),
        (("--segments", 2, "--view"), "--view shows one training, and --segments makes several"),
        (("--segments", 2, "--set=segments.overlap=0.5"), "allowed: 0 or more, below 0.5"),
        (("--segments", 2, "--jobs", 2, "--workers", 2), "--jobs and --workers are both given"),
        (("--jobs", 2), "give --segments as well"),
        (("--segments", 2, "--stream", "--preset", "persistent"), "allowed with --stream: 1"),
        (("--set=data.between=[0.5, 0.5]",), "0 <= start < end <= 1"),
        (("--set=data.between=[0.01, 0.02]",), "no train view lies between 0.01 and 0.02"),
    ],
)
def test_bad_input_is_told(
    rig: Path,
    tmp_path: Path,
    gsdmsr: Gsdmsr,
    capsys: pytest.CaptureFixture[str],
    words: tuple[object, ...],
    message: str,
) -> None:
    assert gsdmsr("train", "--data", rig, "--out", tmp_path / "run", *words) in (2, 3)
    found = capsys.readouterr().err
    assert message in " ".join(found.split())
    assert not (tmp_path / "run").exists()
