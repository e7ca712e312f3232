"""gsdmsr presets: every preset has a purpose, and every option of one its value and meaning."""

from __future__ import annotations

import json
from typing import Any

import pytest

from gsdmsr_cli.commands import presets
from gsdmsr_cli.commands.presets import describe_options
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.options.preset_files import preset_names


def answer(name: str | None, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    with say.on_its_own(as_json=True):
        presets.run(name)
    document = json.loads(capsys.readouterr().out)
    assert isinstance(document, dict)
    return document


def test_every_preset_says_what_it_is_for(capsys: pytest.CaptureFixture[str]) -> None:
    listed = answer(None, capsys)["presets"]
    assert [about["name"] for about in listed] == preset_names()
    for about in listed:
        assert len(about["description"]) > 20 and "\n" not in about["description"], about
    assert next(a for a in listed if a["name"] == "n3v")["base"] == ["video", "default"]
    presets.run(None)
    assert "NVFi" in capsys.readouterr().out


@pytest.mark.parametrize("name", preset_names())
def test_the_options_of_a_preset_are_those_that_set_takes(name: str) -> None:
    preset = load_preset(name, None, [])
    options = list(describe_options(preset))
    keys = [entry["key"] for entry in options]
    assert len(keys) == len(set(keys))
    for entry in options:
        value = json.dumps(entry["value"])
        again = load_preset(name, None, [f"{entry['key']}={value}"])
        assert list(describe_options(again)) == options, entry["key"]
        assert entry["meaning"], entry["key"]


def test_values_are_those_of_the_preset_beside_the_defaults(
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = {entry["key"]: entry for entry in answer("4dgs", capsys)["options"]}
    levels = options["motion.levels"]
    assert (levels["value"], levels["default"]) == ([64, 128], [64, 128])
    steps = options["training.steps"]
    assert (steps["value"], steps["default"], steps["kind"]) == (23000, 10000, "a whole number")
    assert options["motion.name"]["value"] == "hexplane"
    assert "'control_points'" in options["motion.name"]["kind"]
    presets.run("4dgs")
    out = capsys.readouterr().out
    assert "4dgs: another method" in out and "based on default" in out and "motion.levels" in out


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(UsageError, match="unknown preset 'vido'; did you mean 'video'"):
        presets.run("vido")
