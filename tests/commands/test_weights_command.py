"""gsdmsr weights: tells what is there, and fetches only what it is told to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.commands import weights
from gsdmsr_cli.evaluation.weights import Fetched, Source
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError

Fetches = list[tuple[str, Path]]


@pytest.fixture(autouse=True)
def _no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Hide the weights that this machine may have."""
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))


@pytest.fixture
def fetches(monkeypatch: pytest.MonkeyPatch) -> Fetches:
    """What would have been downloaded; an empty file takes its place."""
    calls: Fetches = []

    def fake(wanted: Source, folder: Path, tell: Any) -> Fetched:
        calls.append((wanted.name, folder))
        folder.mkdir(parents=True, exist_ok=True)
        (folder / wanted.name).touch()
        return Fetched(folder / wanted.name, 0, "ab")

    monkeypatch.setattr(weights, "fetch", fake)
    return calls


def test_nothing_is_fetched_unasked(fetches: Fetches, capsys: Any, tmp_path: Path) -> None:
    with say.on_its_own(as_json=True):
        weights.run()
    report = json.loads(capsys.readouterr().out)
    assert report["searched"] == [str(tmp_path / "hub" / "hub" / "checkpoints")]
    for net in ("alex", "squeeze", "vgg"):
        entry = report["nets"][f"lpips_{net}"]
        assert entry["trunk"] is entry["linear"] is None and "no trunk weights" in entry["reason"]
    weights.run()
    assert "gsdmsr weights --fetch vgg" in " ".join(capsys.readouterr().out.split())
    assert not fetches


def test_only_what_is_missing_is_fetched(fetches: Fetches, capsys: Any, tmp_path: Path) -> None:
    to = tmp_path / "to"
    with say.on_its_own(as_json=True):
        weights.run(["vgg", "vgg"], to)
    assert fetches == [("vgg16-397923af.pth", to), ("lpips_vgg.pth", to)]
    out, err = capsys.readouterr()
    assert err.count("fetched https://") == 2 and "SHA-256 ab" in err
    reason = json.loads(out)["nets"]["lpips_vgg"]["reason"]
    assert "not a readable weights file" in reason  # they are empty
    weights.run(["vgg"], to, folder=to)
    assert len(fetches) == 2


def test_they_go_where_every_command_looks(fetches: Fetches, tmp_path: Path, capsys: Any) -> None:
    with say.on_its_own(as_json=True):
        weights.run(["squeeze"])
    entry = json.loads(capsys.readouterr().out)["nets"]["lpips_squeeze"]
    hub = tmp_path / "hub" / "hub" / "checkpoints"
    assert entry["trunk"] == str(hub / "squeezenet1_1-b8a52dc0.pth")
    assert entry["linear"] == str(hub / "lpips_squeeze.pth")


def test_real_weights_are_found_and_load(shared_data: Path, capsys: Any) -> None:
    with say.on_its_own(as_json=True):
        weights.run(folder=shared_data / "lpips")
    nets = json.loads(capsys.readouterr().out)["nets"]
    assert nets["lpips_alex"]["reason"] is nets["lpips_squeeze"]["reason"] is None
    assert nets["lpips_vgg"]["linear"].endswith("vgg.pth") and nets["lpips_vgg"]["trunk"] is None


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="not a folder"):
        weights.run(folder=tmp_path / "absent")


def test_a_network_that_does_not_exist_is_refused_before_any_is_fetched(fetches: Fetches) -> None:
    with pytest.raises(UsageError, match="--fetch alexnet: no such network; did you mean 'alex'"):
        weights.run(["vgg", "alexnet"])
    assert not fetches
