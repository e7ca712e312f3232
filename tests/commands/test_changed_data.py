"""A run and its data: changed pictures are refused by name, and runs of before are accepted."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from training_checks import begun_run

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.runs.run import Run, open_run

FEW = ("splats.count=50", "splats.start=box", "motion={name: static}", "training.views_per_step=1")
Gsdmsr = Callable[..., int]


@pytest.fixture(scope="module")
def begun(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a copy of the data and a run on it that has made no step."""
    root = tmp_path_factory.mktemp("changed")
    data = Path(shutil.copytree(tiny_scene, root / "data"))
    begun_run(data, root / "run", FEW, verify=True)
    return root


@pytest.fixture
def run(begun: Path, tmp_path: Path) -> Run:
    shutil.copytree(begun, tmp_path / "here")
    return replace(open_run(tmp_path / "here" / "run"), data=tmp_path / "here" / "data")


def about(run: Run) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((run.root / "run.json").read_text())
    return document


@pytest.mark.parametrize("command", ["eval", "render", "resume"])
def test_a_changed_picture_is_refused_by_name(
    gsdmsr: Gsdmsr, run: Run, capsys: Any, command: str
) -> None:
    shutil.copyfile(run.data / "train" / "r_003.png", run.data / "train" / "r_004.png")
    words = {
        "eval": ("eval", run.root, "--data", run.data),
        "render": ("render", run.root, "--data", run.data),
        "resume": ("train", "--data", run.data, "--out", run.root, "--resume", "--steps", 1),
    }[command]
    assert gsdmsr(*words) == 3
    message = f"is not the data that {run.root} was trained on: train/r_004.png has changed"
    assert message in capsys.readouterr().err


def test_a_run_of_before_there_was_a_hash_of_pictures_is_read(gsdmsr: Gsdmsr, run: Run) -> None:
    document = about(run)
    assert document["data"].pop("pictures") and len(document["data"]) == 3
    (run.root / "run.json").write_text(json.dumps(document))
    (run.root / "pictures.json").unlink()
    assert gsdmsr("eval", run.root, "--data", run.data) == 0
    protocol = json.loads((run.root / "eval" / "metrics.json").read_text())["protocol"]
    assert protocol["data_fingerprint"] == run.fingerprint
    assert protocol["pictures_fingerprint"] == run.pictures


def test_without_the_list_of_pictures_a_change_is_refused_all_the_same(
    gsdmsr: Gsdmsr, run: Run, capsys: Any
) -> None:
    (run.root / "pictures.json").unlink()
    assert gsdmsr("render", run.root, "--data", run.data, "--path", "orbit", "--frames", 1) == 0
    shutil.copyfile(run.data / "train" / "r_003.png", run.data / "train" / "r_004.png")
    assert gsdmsr("eval", run.root, "--data", run.data) == 3
    assert "was trained on: " in capsys.readouterr().err


def test_whole_hashes_notice_what_samples_do_not(gsdmsr: Gsdmsr, run: Run, capsys: Any) -> None:
    document = json.loads((run.root / "pictures.json").read_text())
    assert document["whole"].keys() == document["sampled"].keys()
    assert len(document["whole"]) == len(read_scene(run.data).views)
    assert gsdmsr("eval", run.root, "--data", run.data, "--verify-data") == 0
    document["whole"]["test/r_001.png"] = "0" * 16  # stands for a byte between the blocks
    (run.root / "pictures.json").write_text(json.dumps(document))
    assert gsdmsr("eval", run.root, "--data", run.data) == 0
    capsys.readouterr()
    line = "train", "--data", run.data, "--out", run.root, "--resume", "--steps", 1
    for words in (("eval", run.root, "--data", run.data), line):
        assert gsdmsr(*words, "--verify-data") == 3
        assert "test/r_001.png has changed; restore it" in capsys.readouterr().err


def test_a_run_without_whole_hashes_says_so(gsdmsr: Gsdmsr, run: Run, capsys: Any) -> None:
    document = json.loads((run.root / "pictures.json").read_text())
    del document["whole"]
    (run.root / "pictures.json").write_text(json.dumps(document))
    assert gsdmsr("eval", run.root, "--data", run.data, "--verify-data") == 3
    assert "it was begun without --verify-data" in capsys.readouterr().err
