"""Help: panels, an example of every command that works, and brackets as they were written."""

from __future__ import annotations

import re
from typing import Any

import pytest
from typer.main import get_command

from gsdmsr_cli.cli._help import EXAMPLES, PANELS, as_it_is
from gsdmsr_cli.cli.main import app

Gsdmsr = Any  # the fixture of conftest.py


def leaves(group: Any, path: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, entry in group.commands.items():
        more = hasattr(entry, "commands")
        found |= leaves(entry, f"{path}{name} ") if more else {path + name: entry}
    return found


COMMANDS = leaves(get_command(app))


def help_of(command: str, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]) -> str:
    gsdmsr.monkeypatch.setenv("COLUMNS", "200")
    gsdmsr.monkeypatch.setenv("TERMINAL_WIDTH", "200")
    assert gsdmsr(f"{command} --help") == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_an_example_that_it_understands(
    command: str, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    example = EXAMPLES[command.split()[-1]]
    assert example.startswith(f"gsdmsr {command} ")
    assert f"Example: {example}" in help_of(command, gsdmsr, capsys)
    assert gsdmsr(example.removeprefix("gsdmsr ")) == 0, capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
def test_brackets_are_shown(
    command: str, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    text = " ".join(re.sub(r"[│╭╮╰╯─]", " ", help_of(command, gsdmsr, capsys)).split())
    for parameter in COMMANDS[command].params:
        written = (getattr(parameter, "help", None) or "").replace("\\[", "[")
        assert written in text, parameter.name


def test_a_length_in_pixels_is_shown_with_its_unit(
    gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "Longer side of the pictures [px]." in help_of("prepare", gsdmsr, capsys)
    assert as_it_is("a [px] of [0, 1] and [/]") == r"a \[px] of [0, 1] and \[/]"


def test_many_options_are_in_panels(gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of("train", gsdmsr, capsys)
    order = [text.index(f" {title} ─") for title in ("Data", "Output", "Length", "Common options")]
    assert order[-1] == max(order)
    assert text.index("--steps") > text.index(" Length ─")


def test_panels_name_parameters_that_there_are() -> None:
    names = {parameter.name for command in COMMANDS.values() for parameter in command.params}
    grouped = [name for names_ in PANELS.values() for name in names_]
    assert len(set(grouped)) == len(grouped)
    assert set(grouped) <= names
