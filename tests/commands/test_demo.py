"""gsdmsr demo: what it runs, in which folder, and which folders it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.commands import demo
from gsdmsr_cli.demo.synthetic import write_scene
from gsdmsr_cli.formats import dnerf
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.durations import parse_duration
from gsdmsr_cli.options.preset import load_preset

Calls = list[tuple[str, tuple[Any, ...]]]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """A tiny scene, and commands that record their arguments instead of working."""
    calls: Calls = []

    def record(name: str, *arguments: Any) -> None:
        calls.append((name, arguments))
        if name == "train":
            arguments[0].out.mkdir(exist_ok=True)
        if name == "render":
            (arguments[0] / "orbit.webm").touch()

    for name, command in [("train", demo.train), ("eval", demo.evaluate), ("render", demo.render)]:
        monkeypatch.setattr(command, "run", lambda *a, name=name: record(name, *a))
    monkeypatch.setattr(
        demo,
        "write_scene",
        lambda folder, progress: write_scene(folder, 16, 2, 1, 1, progress=progress),
    )
    return calls


def test_it_makes_trains_evaluates_renders_and_tells(
    tmp_path: Path, calls: Calls, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "demo"
    demo.run(out)
    assert len(dnerf.read(out / "scene").views) == 4
    assert [name for name, _ in calls] == ["train", "eval", "render"]
    (asked,) = calls[0][1]
    run_folder = out / "run"
    assert (asked.data, asked.out, asked.device) == (out / "scene", run_folder, "auto")
    assert not (asked.resume or asked.overwrite or asked.dry_run)
    budget = load_preset(asked.preset, asked.config, asked.overrides).training.budget
    assert budget is not None
    assert parse_duration(budget) <= 90
    assert calls[1][1][0] == run_folder and calls[1][1][-1].report
    assert calls[1][1][-1].play
    told = capsys.readouterr().out
    for path in ("scene/train", "run/orbit.webm", "run/eval/metrics.json", "run/eval/report.html"):
        assert str(out / path) in told
    assert f"move about in, for a browser: {out / 'run' / 'eval' / 'play.html'}\n" in told


def test_an_earlier_demo_is_made_anew(tmp_path: Path, calls: Calls) -> None:
    demo.run(tmp_path)
    demo.run(tmp_path)
    assert [given[0].overwrite for name, given in calls if name == "train"] == [False, True]


def test_a_folder_with_something_else_is_refused_and_left(tmp_path: Path, calls: Calls) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match="neither empty nor an earlier demo"):
        demo.run(tmp_path)
    with pytest.raises(UsageError, match="is a file"):
        demo.run(tmp_path / "thesis.tex")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert calls == []
