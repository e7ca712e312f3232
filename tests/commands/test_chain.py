"""From a folder of pictures to scores, films and splat files, through the real commands."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numba
import numpy as np
import pytest
import torch
from motion_checks import splats_at

from gsdmsr_cli.benchmark.kills import same
from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.exports._ply import read_ply
from gsdmsr_cli.runs import checkpoints
from gsdmsr_cli.runs.run import open_run
from gsdmsr_cli.scene.imaging import read_image

STEPS = 60

SETTINGS = (
    "splats.count=400", "density.start=10", "density.every=10", "density.cap=600",
    "density.thin_at=[]",
    "training.static_until=0.2",
    "optimizer.planes=[0.05,0.01]", "optimizer.network=[0.02,0.002]",
)  # fmt: skip
"""A field that learns fast, so that splats move visibly after few steps."""

OPTIONS = ["--preset", "dnerf", "--seed", "3", *(f"--set={setting}" for setting in SETTINGS)]


@dataclass
class Ended:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


Gsdmsr = Callable[..., Ended]


def gsdmsr_in_this_process(*arguments: object) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["gsdmsr", *map(str, arguments)])
        patch.setattr(speed, "SECONDS", 0.05)
        patch.setenv("GSDMSR_DEBUG", "1")  # a traceback tells more, should something fail
        with pytest.raises(SystemExit) as ended:
            main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture
def gsdmsr(capfd: pytest.CaptureFixture[str]) -> Gsdmsr:
    """The command line; its output is caught at the file descriptors, libraries' included."""

    def call(*arguments: object) -> Ended:
        capfd.readouterr()
        code = gsdmsr_in_this_process(*arguments)
        return Ended(code, *capfd.readouterr())

    return call


@pytest.fixture(scope="module")
def data(tiny_scene: Path) -> Path:
    return tiny_scene


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder, trained with a break at half of the steps."""
    folder = tmp_path_factory.mktemp("chain") / "run"
    whole = ["train", "--data", data, "--out", folder]
    assert gsdmsr_in_this_process(*whole, *OPTIONS, "--steps", STEPS // 2) == 0
    half = open_run(folder).load()
    assert half.step == STEPS // 2
    assert gsdmsr_in_this_process(*whole, "--resume", "--steps", STEPS) == 0
    return folder


@pytest.fixture
def copied(run: Path, tmp_path: Path) -> Path:
    """The run folder at another place, for who changes it."""
    return Path(shutil.copytree(run, tmp_path / "run"))


@pytest.fixture(scope="module")
def lpips_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Without weights, whatever this machine has."""
    return tmp_path_factory.mktemp("lpips")


@pytest.fixture(autouse=True)
def no_lpips_weights(monkeypatch: pytest.MonkeyPatch, lpips_folder: Path) -> None:
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(lpips_folder))


def test_training_writes_a_run_with_log_and_account(run: Path) -> None:
    assert {path.name for path in run.iterdir()} >= {
        "run.json", "metrics.jsonl", "checkpoint.safetensors", "training.json",
    }  # fmt: skip
    assert not list(run.rglob("*.part"))
    log = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    steps = [entry["step"] for entry in log]
    assert steps == sorted(set(steps)) and steps[-1] == STEPS
    assert log[-1]["val_psnr"] > log[0]["val_psnr"] + 1
    account = json.loads((run / "training.json").read_text())
    assert (account["steps"], account["progress"]) == (STEPS, 1.0)
    assert 0 < account["train_s"] < 120 and account["load_s"] > 0 and account["compile_s"] > 0
    assert 400 < account["splats"] == log[-1]["splats"] <= 600
    assert account["device"] == "cpu" and account["threads"] == numba.config.NUMBA_NUM_THREADS
    assert 1 <= account["processes"] <= min(2, account["threads"])
    opened = open_run(run)
    assert (opened.name, opened.preset.training.steps) == ("dnerf", STEPS)
    assert (opened.preset.splats.count, opened.preset.training.seed) == (400, 3)


def test_a_complete_run_is_not_resumed(gsdmsr: Gsdmsr, run: Path, data: Path) -> None:
    ended = gsdmsr("train", "--data", data, "--out", run, "--resume")
    assert ended.code == 2 and "is complete at step 60" in ended.err


def test_a_run_killed_after_its_last_checkpoint_is_completed(
    gsdmsr: Gsdmsr, run: Path, data: Path, tmp_path: Path
) -> None:
    killed = tmp_path / "killed"
    shutil.copytree(run, killed)
    (killed / "training.json").unlink()
    (killed / f".gsdmsr-{'0' * 32}.part.json").write_text("{")  # as far as it was written
    ended = gsdmsr("train", "--data", data, "--out", killed, "--resume")
    assert ended.code == 0, ended.err
    assert {path.name for path in killed.iterdir()} == {path.name for path in run.iterdir()}
    account, whole = (json.loads((of / "training.json").read_text()) for of in (killed, run))
    assert account["steps"] == whole["steps"] and account["progress"] == 1
    assert account["train_s"] == pytest.approx(whole["train_s"], abs=2)
    assert (killed / "metrics.jsonl").read_bytes() == (run / "metrics.jsonl").read_bytes()
    found, expected = (open_run(of).load() for of in (killed, run))
    assert same(found, expected)
    ended = gsdmsr("train", "--data", data, "--out", killed, "--resume")
    assert ended.code == 2 and "is complete at step 60" in ended.err


def test_a_run_in_use_is_refused(gsdmsr: Gsdmsr, run: Path, data: Path) -> None:
    before = (run / "checkpoint.safetensors").read_bytes()
    ended = gsdmsr("train", "--data", data, "--out", run, *OPTIONS, "--steps", 2)
    assert ended.code == 3 and "--resume" in ended.err and "--overwrite" in ended.err
    assert (run / "checkpoint.safetensors").read_bytes() == before


def test_a_resumed_training_may_only_become_longer(gsdmsr: Gsdmsr, run: Path, data: Path) -> None:
    line = "train", "--data", data, "--out", run, "--resume", "--steps", 90
    ended = gsdmsr(*line, "--set", "splats.count=500")
    assert ended.code == 2
    assert "splats.count = 400, not 500" in ended.err
    ended = gsdmsr(*line, "--set", "events=[density]")
    assert ended.code == 2
    listed = '"density", "opacity_reset", "thinning", "stillness"'
    assert f'was trained with events = [{listed}], not ["density"]; --resume' in ended.err


def test_overwriting_starts_anew(gsdmsr: Gsdmsr, copied: Path, data: Path) -> None:
    line = "train", "--data", data, "--out", copied, *OPTIONS, "--steps", 3
    ended = gsdmsr(*line, "--overwrite")
    assert ended.code == 0 and ended.out == ""
    assert open_run(copied).load().step == 3
    log = (copied / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in log] == [1, 2, 3]


def document_of(ended: Ended) -> dict[str, Any]:
    """Return the JSON object that stdout holds, and hold it to be all that stdout holds."""
    assert ended.out.endswith("\n") and ended.out.count("\n") == 1
    document = json.loads(ended.out)
    assert isinstance(document, dict)
    return document


def test_eval_measures_every_frame(gsdmsr: Gsdmsr, run: Path) -> None:
    ended = gsdmsr("eval", run, "--json", "--fail-under", "psnr=12", "--fail-under", "ssim=0.1")
    assert ended.code == 0 and ended.err == ""
    document = document_of(ended)
    assert json.loads((run / "eval" / "metrics.json").read_text()) == document
    assert document["schema"] == 1
    about = document["protocol"]
    assert (about["split"], about["resolution"], about["background"]) == ("test", [48, 48], "white")
    assert (about["checkpoint_step"], about["device"], about["seed"]) == (STEPS, "cpu", 3)
    frames = document["frames"]
    assert [frame["time"] for frame in frames] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    for metric in ("psnr", "psnr_float", "ssim"):
        mean = np.mean([frame[metric] for frame in frames])
        assert document["aggregate"][metric] == pytest.approx(mean)
    assert 12 < document["aggregate"]["psnr"] < 100 and 0.1 < document["aggregate"]["ssim"] < 1
    for net in ("alex", "squeeze", "vgg"):
        entry = document["aggregate"][f"lpips_{net}"]
        assert entry["value"] is None and entry["reason"] and entry["searched"]
    assert {name: own["frames"] for name, own in document["splits"].items()} == {
        "test": 4, "train": 12, "val": 3
    }  # fmt: skip
    assert document["splits"]["test"]["psnr"] == document["aggregate"]["psnr"]
    assert document["speed"]["fps_raster"] > 0 and document["speed"]["fps"] > 0
    sizes = document["storage"]
    assert sizes["checkpoint_bytes"] == (run / "checkpoint.safetensors").stat().st_size
    parts = sizes["splats_bytes"] + sizes["motion_bytes"] + sizes["training_state_bytes"]
    assert 0 < sizes["checkpoint_bytes"] - parts < 20_000
    assert document["training"]["steps"] == STEPS


def test_benchmark_still_compares_thresholds(gsdmsr: Gsdmsr, run: Path) -> None:
    """At the smallest nothing stands still, at the largest everything does."""
    line = "benchmark", "still", run, "--split", "test"
    ended = gsdmsr(*line, "--below", "1e-9", "--below", "1e9", "--json")
    assert ended.code == 0 and ended.err == ""
    document = document_of(ended)
    report = document_of(gsdmsr("eval", run, "--json"))
    trained, none, whole = document["rows"]
    assert [row["below"] for row in document["rows"]] == [0, 1e-9, 1e9]
    assert [row["still"] for row in document["rows"]] == [0, 0, 1]
    assert trained["psnr"] == none["psnr"] == report["aggregate"]["psnr"] != whole["psnr"]
    assert trained["ratio"] == 1 and whole["fps"] > 0
    assert "as trained" in gsdmsr(*line, "--below", "1").out
    refused = gsdmsr(*line, "--below", "0")
    assert refused.code == 2 and refused.err.endswith("error: --below 0.0: must be above 0\n")


def test_benchmark_still_reads_the_checkpoint_once(
    gsdmsr: Gsdmsr, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A training that goes on there would else mix two models in one table."""
    real, reads = checkpoints.read, list[Path]()
    monkeypatch.setattr(checkpoints, "read", lambda path: (reads.append(path), real(path))[1])
    line = "--below", "0.1", "--below", "1", "--below", "2"
    assert gsdmsr("benchmark", "still", run, "--split", "test", *line).code == 0
    assert len(reads) == 1


def test_eval_takes_another_split_background_and_size(gsdmsr: Gsdmsr, run: Path) -> None:
    line = "eval", run, "--json", "--split", "val", "--background", "black", "--downscale", 2
    document = document_of(gsdmsr(*line))
    about = document["protocol"]
    assert (about["split"], about["resolution"], about["background"]) == ("val", [24, 24], "black")
    assert len(document["frames"]) == 3


@pytest.mark.parametrize(
    ("threshold", "message"),
    [
        ("psnr=60", "psnr is "),
        ("ssim=0.9999", "ssim is "),
        ("ms_ssim=0.1", "ms_ssim has no value, wanted 0.1 or more"),
        ("lpips_vgg=0.3", "lpips_vgg has no value, wanted 0.3 or less"),
    ],
)
def test_a_missed_threshold_ends_with_4(
    gsdmsr: Gsdmsr, run: Path, threshold: str, message: str
) -> None:
    option = "--fail-over" if "lpips" in threshold else "--fail-under"
    ended = gsdmsr("eval", run, "--json", "--fail-under", "psnr=1", option, threshold)
    assert ended.code == 4
    assert message in ended.err.splitlines()[-1]
    assert document_of(ended)["aggregate"]["psnr"] > 1  # the report is there all the same


@pytest.mark.parametrize("threshold", ["psnr", "psnr=", "psnr=nan", "snr=3", "=3"])
def test_a_threshold_that_is_none_is_refused_before_the_work(
    gsdmsr: Gsdmsr, copied: Path, threshold: str
) -> None:
    shutil.rmtree(copied / "eval", ignore_errors=True)
    ended = gsdmsr("eval", copied, "--fail-under", threshold)
    assert ended.code == 2 and threshold in ended.err and ended.out == ""
    assert not (copied / "eval").exists()


def test_eval_without_json_prints_a_table(gsdmsr: Gsdmsr, run: Path) -> None:
    ended = gsdmsr("eval", run)
    assert ended.code == 0
    for word in ("psnr", "ssim", "lpips_vgg", "frames a second", "metrics.json"):
        assert word in ended.out


def test_a_moved_run_finds_its_moved_data(gsdmsr: Gsdmsr, copied: Path, data: Path) -> None:
    path = copied / "run.json"
    path.write_text(path.read_text().replace(str(data.resolve()), "/not/there"))
    ended = gsdmsr("eval", copied)
    assert ended.code == 3 and "--data" in ended.err
    assert gsdmsr("eval", copied, "--data", data).code == 0
    assert gsdmsr("render", copied, "--path", "test", "--data", data).code == 0


def film_of(path: Path) -> list[np.ndarray]:
    """Return the frames of a video, (H, W, 3) RGB."""
    video, frames = cv2.VideoCapture(str(path)), []
    while True:
        there, frame = video.read()
        if not there:
            return frames
        frames.append(frame[..., ::-1])


@pytest.mark.parametrize(("path", "count"), [("test", 4), ("orbit", 6)])
def test_render_writes_pictures_and_a_film_of_them(
    gsdmsr: Gsdmsr, run: Path, tmp_path: Path, path: str, count: int
) -> None:
    frames = ["--frames", count] if path == "orbit" else []
    ended = gsdmsr("render", run, "--path", path, *frames, "--out", tmp_path / "film")
    assert ended.code == 0 and "webm" in ended.out
    pictures = sorted((tmp_path / "film" / path).iterdir())
    assert [picture.name for picture in pictures] == [f"{i:04d}.png" for i in range(count)]
    film = film_of(tmp_path / "film" / f"{path}.webm")
    assert len(film) == count
    for picture, frame in zip(pictures, film, strict=True):
        pixels = read_image(picture).astype(np.float64)
        assert pixels.shape == (48, 48, 3) == frame.shape
        assert np.abs(pixels - frame).mean() < 12  # compressed, but the same picture
        assert pixels.std() > 10  # of something


def test_rendered_test_views_are_those_that_eval_scores(
    gsdmsr: Gsdmsr, run: Path, data: Path, tmp_path: Path
) -> None:
    """PSNR by hand, from the files alone."""
    scored = document_of(gsdmsr("eval", run, "--json"))["frames"]
    assert gsdmsr("render", run, "--path", "test", "--out", tmp_path).code == 0
    for i, frame in enumerate(scored):
        drawn = read_image(tmp_path / "test" / f"{i:04d}.png") / 255
        rgba = read_image(data / "test" / f"r_{i:03d}.png") / 255
        alpha = rgba[..., 3:]
        true = np.rint(255 * (rgba[..., :3] * alpha + 1 - alpha)) / 255
        error = np.square(drawn - true).mean()
        assert -10 * np.log10(error) == pytest.approx(frame["psnr"], abs=2e-3)


def test_render_without_a_path_draws_both(gsdmsr: Gsdmsr, copied: Path) -> None:
    ended = gsdmsr("render", copied, "--frames", 3)
    assert ended.code == 0
    found = {str(path.relative_to(copied / "render")) for path in copied.rglob("*.webm")}
    assert found == {"test.webm", "orbit.webm"}


def test_exported_splats_are_moved_ones(gsdmsr: Gsdmsr, run: Path, tmp_path: Path) -> None:
    model, _ = open_run(run).load_model()
    for moment in (0.0, 0.4, 1.0):
        path = tmp_path / f"{moment}.ply"
        ended = gsdmsr("export", run, "--format", "ply", "--time", moment, "--out", path)
        assert ended.code == 0 and "wrote" in ended.out
        found, expected = read_ply(path).tensors(), splats_at(model, moment).tensors()
        for name, tensor in expected.items():
            if name != "quats":  # stored at unit length
                assert torch.equal(found[name], tensor), name
    first, last = (read_ply(tmp_path / f"{moment}.ply") for moment in (0.0, 1.0))
    assert (first.means - last.means).norm(dim=1).max() > 1e-3
    assert not torch.equal(first.quats, last.quats)


def test_an_option_of_an_export_may_be_given_by_its_name(
    gsdmsr: Gsdmsr, run: Path, tmp_path: Path
) -> None:
    named, set_ = tmp_path / "named.ply", tmp_path / "set.ply"
    line = "export", run, "--format", "ply", "--out"
    assert gsdmsr(*line, named, "--time", 0.4).code == 0
    assert gsdmsr(*line, set_, "--set", "time=0.4").code == 0
    assert named.read_bytes() == set_.read_bytes()
    refused = gsdmsr(*line, tmp_path / "x.ply", "--set", "tiem=0.4")
    expected = "--set tiem=0.4 is not for --format ply, which takes time; drop it"
    assert refused.code == 2 and refused.err.endswith(f"error: {expected}\n")
    refused = gsdmsr(*line, tmp_path / "x.ply", "--set", "time=late")
    assert refused.code == 2 and 'time is "late"; allowed: a number' in refused.err
    assert not (tmp_path / "x.ply").exists()


def test_a_sequence_of_splats_moves(gsdmsr: Gsdmsr, run: Path, tmp_path: Path) -> None:
    out = tmp_path / "sequence"
    ended = gsdmsr("export", run, "--format", "ply-sequence", "--frames", 3, "--out", out)
    assert ended.code == 0
    paths = sorted(out.glob("*.ply"))
    assert [path.name for path in paths] == [f"frame000{i}.ply" for i in (1, 2, 3)]
    means = [read_ply(path).means for path in paths]
    assert len({len(m) for m in means}) == 1
    assert not torch.equal(means[0], means[1]) and not torch.equal(means[1], means[2])
    model, _ = open_run(run).load_model()
    assert torch.equal(means[1], splats_at(model, 0.5).means)


def test_stdout_of_a_process_holds_one_json_object(run: Path) -> None:
    """As a pipe sees it, with libraries and exit hooks."""
    line = [sys.executable, "-m", "gsdmsr_cli", "eval", str(run), "--json"]
    done = subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert document_of(Ended(0, done.stdout, ""))["protocol"]["split"] == "test"


def test_ctrl_c_leaves_a_run_to_go_on_with(data: Path, tmp_path: Path, gsdmsr: Gsdmsr) -> None:
    out = tmp_path / "run"
    arguments = ["train", "--data", str(data), "--out", str(out), *OPTIONS, "--steps=1000000"]
    process = subprocess.Popen(
        [sys.executable, "-m", "gsdmsr_cli", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    deadline = time.monotonic() + 300
    while not (out / "metrics.jsonl").is_file() and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    told, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and told == ""
    assert "Traceback" not in errors and "--resume" in errors.splitlines()[-1]
    step = open_run(out).load().step
    assert step > 0
    log = (out / "metrics.jsonl").read_text().splitlines()
    assert json.loads(log[-1])["step"] == step
    line = "train", "--data", data, "--out", out, "--resume", "--steps", step + 2
    assert gsdmsr(*line).code == 0
    assert open_run(out).load().step == step + 2
