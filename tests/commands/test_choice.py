"""A training whose preset is not named takes the one that suits its data, and says so."""

from __future__ import annotations

import json
import re
import shlex
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from datasets import write_dnerf

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.commands._choice import Choice
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs.run import open_run
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.memory import estimate

STEPS = ["training.steps=2"]


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return read_scene(write_dnerf(tmp_path / "scene"))


def config(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_preset_that_is_not_named_follows_from_the_data(scene: Scene) -> None:
    choice = Choice(None, None, STEPS)
    assert not choice.named
    chosen = choice.suit(scene)
    assert chosen.options == load_preset("dnerf", None, STEPS)
    assert chosen.name == "dnerf"
    assert chosen.reason == "preset dnerf, since the data has the layout dnerf"


def test_a_file_without_a_base_stands_over_what_the_data_calls_for(
    scene: Scene, tmp_path: Path
) -> None:
    path = config(tmp_path, "density: {cap: 777}")
    chosen = Choice(None, path, STEPS).suit(scene)
    assert chosen.options == load_preset("dnerf", path, STEPS)
    assert chosen.options.density.cap == 777 and chosen.options.density.rounds == 48
    assert chosen.name == "mine.yaml" and chosen.reason is not None


@pytest.mark.parametrize(
    ("preset", "text", "name"),
    [("video", None, "video"), (None, "base: video", "mine.yaml"), ("video", "{}", "video")],
)
def test_a_preset_that_is_named_is_taken(
    scene: Scene, tmp_path: Path, preset: str | None, text: str | None, name: str
) -> None:
    choice = Choice(preset, None if text is None else config(tmp_path, text), STEPS)
    chosen = choice.suit(scene)
    assert choice.named and chosen.options == choice.check() == load_preset("video", None, STEPS)
    assert (chosen.name, chosen.reason) == (name, None)


@pytest.mark.parametrize(
    ("override", "where"),
    [("density.cup=4", "cup"), ("density.cap=many", "density.cap"), ("motion.neighbors=4", None)],
)
def test_mistakes_are_told_before_the_data_is_read_where_they_can_be(
    scene: Scene, override: str, where: str | None
) -> None:
    choice = Choice(None, None, [override])
    if where is not None:
        with pytest.raises(UsageError, match=where):
            choice.check()
    with pytest.raises(UsageError, match=where or r"neighbors.*neighbours"):
        choice.suit(scene)


def gsdmsr(line: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(sys, "argv", shlex.split(line))
    with pytest.raises(SystemExit) as ended:
        main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_a_training_says_which_preset_and_why_and_goes_on_with_it(
    tiny_scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run, said = tmp_path / "run", "preset dnerf, since the data has the layout dnerf"
    line = f"gsdmsr train --data {tiny_scene} --out {run} --set splats.count=50"
    assert gsdmsr(f"{line} --steps 2", monkeypatch) == 0
    assert capsys.readouterr().err.splitlines()[0] == f"{said}; --preset names another"
    about = json.loads((run / "run.json").read_text())
    assert (about["name"], about["reason"]) == ("dnerf", said)
    assert about["preset"]["motion"]["name"] == "control_points"
    assert gsdmsr(f"{line} --steps 3 --resume", monkeypatch) == 0
    assert said not in capsys.readouterr().err
    assert open_run(run).load().step == 3 and open_run(run).reason == said


def test_what_prepare_says_comes_next_can_be_pasted(
    tiny_scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert gsdmsr(f"gsdmsr prepare {tiny_scene} --out 'a scene; (1)'", monkeypatch) == 0
    following = capsys.readouterr().out.splitlines()[-1].removeprefix("next: ")
    assert gsdmsr(f"{following} --set splats.count=50 --steps 2", monkeypatch) == 0
    about = json.loads((tmp_path / "runs" / "a scene; (1)" / "run.json").read_text())
    assert about["name"] == "dnerf"  # though the scene folder has nerfstudio's layout
    assert "since the data has the layout dnerf" in capsys.readouterr().err


def test_a_dry_run_says_what_would_be_done_and_writes_nothing(
    tiny_scene: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    line = f"gsdmsr train --data {tiny_scene} --out {run} --set splats.count=50"
    before = sorted(path for path in tiny_scene.rglob("*"))
    assert gsdmsr(f"{line} --steps 9 --dry-run --json", monkeypatch) == 0
    plan = json.loads(capsys.readouterr().out)
    assert not run.exists() and sorted(tiny_scene.rglob("*")) == before
    assert (plan["preset"], plan["splats"], plan["length"]) == ("dnerf", 50, "9 steps")
    assert plan["reason"].startswith("preset dnerf, since") and plan["begins_at_step"] == 0
    assert plan["options"]["splats.count"] == 50 and plan["options"]["density.gradient"] == 3e-4
    assert "density.cap" not in plan["options"]  # which is the default
    assert plan["scene"]["pictures"]["train"] == 12 and plan["size"] == [48, 48]
    assert plan["device"] == "cpu" and 1 <= plan["processes"] <= 2
    views, options = read_scene(tiny_scene).split("train"), load_preset("dnerf", None, [])
    expected = estimate(views, options, plan["processes"])
    sizes = asdict(expected) | {"total": expected.total}
    assert plan["memory_mib"] == {name: round(size / (1 << 20)) for name, size in sizes.items()}
    assert plan["memory_mib"]["splats"] > 0 and plan["memory_mib"]["total"] > 0
    assert gsdmsr(f"{line} --steps 2", monkeypatch) == 0
    files = {path: path.read_bytes() for path in run.iterdir()}
    assert gsdmsr(f"{line} --steps 2 --dry-run", monkeypatch) == 3  # RUN is in use
    assert "--overwrite" in capsys.readouterr().err
    assert gsdmsr(f"{line} --steps 7 --resume --dry-run", monkeypatch) == 0
    out = capsys.readouterr().out
    assert "begins at step │ 2" in out and "nothing has been written" in out
    assert re.search(r"memory mib +│ \d+ \(pictures \d+, splats \d+", out)
    assert {path: path.read_bytes() for path in run.iterdir()} == files


def test_a_dry_run_does_not_decode_videos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cam00.mp4").write_bytes(b"")
    (tmp_path / "poses_bounds.npy").write_bytes(b"")
    line = f"gsdmsr train --data {tmp_path} --out {tmp_path / 'run'} --dry-run"
    assert gsdmsr(line, monkeypatch) == 3
    assert "a dry run writes nothing" in capsys.readouterr().err
