"""A disk that is full at any write of a command: a sentence, and nothing that looks finished."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from full_disk import full_at_every_change, has_failed

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.commands import eval as evaluation
from gsdmsr_cli.demo.synthetic import write_scene
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.exports._ply import read_ply
from gsdmsr_cli.runs.run import open_run

FEW = (
    "--preset=dnerf",
    "--steps=2",
    "--threads=1",
    "--set=splats.count=100",
    "--set=density.thin_at=[]",
)

Gsdmsr = Callable[..., tuple[int, str]]


@pytest.fixture
def gsdmsr(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Gsdmsr:
    """Runs a command line; returns its exit code and what it says on stderr."""
    monkeypatch.setattr(speed, "SECONDS", 0.01)
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)

    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["gsdmsr", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(str(ended.value.code)), capsys.readouterr().err

    return call


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("full") / "scene"
    write_scene(folder, size=32, train=4, val=1, test=2)
    return folder


@pytest.fixture
def run(scene: Path, tmp_path: Path, gsdmsr: Gsdmsr) -> Path:
    assert gsdmsr("train", "--data", scene, "--out", tmp_path / "run", *FEW)[0] == 0
    return tmp_path / "run"


def assert_told(code: int, said: str) -> None:
    *_, line = said.splitlines() or [""]
    assert code == 3 and said.count("error: ") == 1 and "Traceback" not in said, said
    assert line.startswith("error: ") and "No space left on device" in line


def test_an_evaluation(run: Path, tmp_path: Path, gsdmsr: Gsdmsr, monkeypatch: Any) -> None:
    known, measured = list[Any](), evaluation.measure

    def measure(*given: Any) -> Any:
        known[:] = known or [measured(*given)]
        return known[0]

    monkeypatch.setattr(evaluation, "measure", measure)
    files = "eval/metrics.json", "eval/report.md", "eval/report.html", "j.xml"
    for place, full in full_at_every_change(tmp_path / "out", 8):
        wishes = "--fail-under=psnr=1", f"--junit={place / 'j.xml'}", "--report"
        given = "eval", run, *wishes, f"--out={place / 'eval'}"
        with full:
            code, said = gsdmsr(*given)
        for path in (place / name for name in files if (place / name).exists()):
            text = path.read_text(encoding="utf-8")
            if path.suffix == ".json":
                json.loads(text)
            elif path.suffix == ".xml":
                ElementTree.fromstring(text)
            assert text.endswith("</html>\n" if path.suffix == ".html" else "\n")
        if has_failed():
            assert_told(code, said)
            assert gsdmsr(*given)[0] == 0
        found = sorted(path.relative_to(place).as_posix() for path in place.rglob("*.*"))
        assert found == sorted(files)


@pytest.mark.parametrize(
    ("format_", "wish", "count"), [("ply", "--time=0", 1), ("ply-sequence", "--frames=3", 3)]
)
def test_an_export(
    run: Path, tmp_path: Path, gsdmsr: Gsdmsr, format_: str, wish: str, count: int
) -> None:
    for place, full in full_at_every_change(tmp_path / "out", 2):
        out = place / ("deep/half.ply" if format_ == "ply" else "frames")
        given = "export", run, f"--format={format_}", wish, f"--out={out}"
        with full:
            code, said = gsdmsr(*given)
        for path in place.rglob("*.ply"):
            assert len(read_ply(path).means) == 100
        if has_failed():
            assert_told(code, said)
            note = out / "ply-sequence.json"
            assert not note.exists() or not json.loads(note.read_text())["whole"]
            assert gsdmsr(*given)[0] == 0
        assert len(list(place.rglob("*.ply"))) == count
        assert not [path for path in place.rglob("*") if ".part" in path.name]


def test_a_training(scene: Path, tmp_path: Path, gsdmsr: Gsdmsr) -> None:
    """It is refused, or goes on after a warning; what is there then is as it says."""
    for place, full in full_at_every_change(tmp_path / "out", 10, 4):
        given = "train", "--data", scene, "--out", place / "run", *FEW
        with full:
            code, said = gsdmsr(*given)
        if (place / "run" / "checkpoint.safetensors").exists():
            assert open_run(place / "run").load().step in (0, 2)
        if code != 0:
            assert_told(code, said)
            code, said = gsdmsr(*given, "--overwrite")
            assert code == 0, said
        else:
            assert ("warning: " in said) == has_failed(), said
        assert open_run(place / "run").load().step == 2
        assert not [path for path in place.rglob("*") if ".part" in path.name]
