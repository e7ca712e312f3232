"""A run is exported as one small file that moves, and the file stands for the run."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from training_checks import begun_run

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.moving.container import MAGIC, from_bytes, to_bytes

QUICK = "splats.count=300", "training.static_until=0.1", "training.threads=1"

Gsdmsr = Callable[..., tuple[int, Any, str]]


@pytest.fixture
def gsdmsr(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Gsdmsr:
    """Runs a command line; returns its exit code, what it has answered, and what it has said."""
    monkeypatch.setattr(speed, "SECONDS", 0.05)

    def call(*words: object) -> tuple[int, Any, str]:
        threads = torch.get_num_threads()
        monkeypatch.setattr(sys, "argv", ["gsdmsr", *map(str, words), "--json"])
        with pytest.raises(SystemExit) as ended:
            main()
        torch.set_num_threads(threads)
        printed = capsys.readouterr()
        lines = printed.out.splitlines()
        return (
            int(str(ended.value.code or 0)),
            json.loads(lines[-1]) if lines else None,
            printed.err,
        )

    return call


@pytest.fixture
def train(gsdmsr: Gsdmsr) -> Callable[[Path, Path], None]:
    """Trains a run on a scene."""

    def call(data: Path, out: Path) -> None:
        options = [word for option in QUICK for word in ("--set", option)]
        line = "train", "--data", data, "--out", out, "--preset", "dnerf", "--steps", 200
        assert gsdmsr(*line, *options)[0] == 0

    return call


@pytest.fixture
def run(tiny_scene: Path, tmp_path: Path) -> Path:
    """A run that has made no step."""
    return begun_run(tiny_scene, tmp_path / "begun", QUICK).root


def test_it_stands_for_the_run(
    gsdmsr: Gsdmsr, train: Callable[[Path, Path], None], tiny_scene: Path, tmp_path: Path
) -> None:
    file, run = tmp_path / "scene.dsplat", tmp_path / "run"
    train(tiny_scene, run)
    code, wrote, _ = gsdmsr("export", run, "--format", "moving", "--out", file, "--loss", 0.05)
    assert code == 0 and wrote["files"] == [str(file)]
    assert 0 < wrote["loss_db"] <= 0.05 and wrote["measured_on"] == "train views"
    assert sum(wrote["bytes_of"].values()) == wrote["bytes"] == file.stat().st_size
    file = file.rename(tmp_path / "moved.dsplat")  # nothing in it depends on where it is
    assert str(tmp_path).encode() not in file.read_bytes()

    code, before, _ = gsdmsr("eval", run)
    assert code == 0
    code, after, _ = gsdmsr("eval", file, "--data", tiny_scene)
    assert code == 0
    assert abs(before["aggregate"]["psnr"] - after["aggregate"]["psnr"]) < 0.1
    storage = [d["storage"]["splats_bytes"] + d["storage"]["motion_bytes"] for d in (before, after)]
    assert storage[1] == file.stat().st_size < storage[0] / 3
    assert (tmp_path / "moved.dsplat.results" / "eval" / "metrics.json").is_file()
    assert not (tmp_path / "eval").exists()

    code, drawn, _ = gsdmsr("render", file, "--data", tiny_scene, "--path", "orbit", "--frames", 2)
    assert code == 0 and drawn["films"][0]["drawn"] == 2
    code, told, _ = gsdmsr("info", file)
    assert code == 0 and told["sound"] and told["facts"]["preset"] == "dnerf"
    code, ply, _ = gsdmsr("export", file, "--format", "ply", "--out", tmp_path / "a.ply")
    assert code == 0 and ply["splats"] == wrote["splats"]


def test_without_the_data_views_on_a_circle_are_compared(
    gsdmsr: Gsdmsr, train: Callable[[Path, Path], None], tiny_scene: Path, tmp_path: Path
) -> None:
    file, run, elsewhere = (tmp_path / name for name in ("a.dsplat", "run", "elsewhere"))
    shutil.copytree(tiny_scene, tmp_path / "data")
    train(tmp_path / "data", run)
    (tmp_path / "data").rename(elsewhere)
    code, wrote, said = gsdmsr("export", run, "--format", "moving", "--out", file)
    assert code == 0 and wrote["measured_on"] == "a circle" and wrote["psnr"] is None
    assert "say with --data" in said
    code, wrote, _ = gsdmsr("export", run, "--format", "moving", "--out", file, "--data", elsewhere)
    assert code == 0 and wrote["measured_on"] == "train views"
    code, _, said = gsdmsr("eval", file)
    assert code == 3 and "say so with --data" in said


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (("--axes", "y-up"), 2, "--axes is not for files that are played"),
        (("--scale", 2), 2, "--scale is not for files that are played"),
        (("--loss", 0), 2, "above 0"),
        (("--time", 0.5), 2, "--time is not for --format moving"),
        (("--data", "nowhere"), 3, "nowhere"),
    ],
)
def test_what_cannot_be_done_is_one_line(
    gsdmsr: Gsdmsr, run: Path, tmp_path: Path, options: tuple[object, ...], code: int, words: str
) -> None:
    file = tmp_path / "a.dsplat"
    found, _, said = gsdmsr("export", run, "--format", "moving", "--out", file, *options)
    assert (found, file.exists()) == (code, False) and words in said


def test_a_run_without_a_checkpoint_is_refused(gsdmsr: Gsdmsr, run: Path, tmp_path: Path) -> None:
    (run / "checkpoint.safetensors").unlink()
    line = "export", run, "--format", "moving", "--out", tmp_path / "a.dsplat"
    code, _, said = gsdmsr(*line)
    assert code == 3 and "no checkpoint yet" in said


def test_other_names_are_refused(gsdmsr: Gsdmsr, run: Path, tmp_path: Path) -> None:
    code, _, said = gsdmsr("export", run, "--format", "moving", "--out", tmp_path / "a.bin")
    assert code == 2 and "does not end in .dsplat" in said


def _newer(data: bytes) -> bytes:
    return MAGIC + (9).to_bytes(4, "little") + data[12:]


def _of_nobody(data: bytes) -> bytes:
    header, parts = from_bytes(data)
    del header["about"], header["parts"]
    return to_bytes(header, list(parts.values()))


def _flipped(data: bytes) -> bytes:
    return data[:-200] + bytes(255 - value for value in data[-200:])


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda data: data[:2000], "is cut short"),
        (lambda data: data[:-1], "is cut short"),
        (lambda data: b"ply\n" + data, "is not a .dsplat file"),
        (lambda data: b"", "is not a .dsplat file"),
        (_newer, "of version 9; this program reads 1"),
        (_of_nobody, "does not say which run it is of"),
        (_flipped, "damaged"),
    ],
)
def test_files_that_are_not_sound_are_named(
    gsdmsr: Gsdmsr,
    run: Path,
    tiny_scene: Path,
    tmp_path: Path,
    spoil: Callable[[bytes], bytes],
    words: str,
) -> None:
    file = tmp_path / "a.dsplat"
    assert gsdmsr("export", run, "--format", "moving", "--out", file)[0] == 0
    file.write_bytes(spoil(file.read_bytes()))
    for line in (
        ("eval", file, "--data", tiny_scene),
        ("export", file, "--format", "ply", "--out", "a.ply"),
    ):
        code, _, said = gsdmsr(*line)
        assert code == 3 and words in said and "Traceback" not in said, said
    assert gsdmsr("info", file)[0] == 3
