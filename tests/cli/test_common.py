"""The options that every command has: --json, --quiet, --verbose and --log-file."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from gsdmsr_cli.cli.main import app
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, ThresholdError

Gsdmsr = Any  # the fixture of conftest.py


def commands(group: Any) -> list[Any]:
    return [
        leaf
        for entry in group.commands.values()
        for leaf in (commands(entry) if hasattr(entry, "commands") else [entry])
    ]


def test_every_command_has_them() -> None:
    found = commands(get_command(app))
    assert len(found) > 10
    for command in found:
        options = {name for parameter in command.params for name in parameter.opts}
        wanted = {"--json", "--quiet", "-q", "--verbose", "-v", "--log-file"}
        assert wanted <= options, command.name


@pytest.fixture
def talkative(gsdmsr: Gsdmsr) -> Gsdmsr:
    """Commands that say a line of each kind and have a result."""

    def record(name: str, arguments: tuple[Any, ...]) -> None:
        say.detail("a detail")
        say.note("a note")
        say.warn("a warning")
        say.result({"a": [1]}, "a is 1")
        if gsdmsr.failure is not None:
            raise gsdmsr.failure

    gsdmsr.record = record
    return gsdmsr


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("", ["a note", "warning: a warning"]),
        ("-q", ["warning: a warning"]),
        ("--quiet", ["warning: a warning"]),
        ("--verbose", ["a detail", "a note", "warning: a warning"]),
    ],
)
def test_stderr_says_as_much_as_is_wanted(
    options: str, said: list[str], talkative: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert talkative(f"doctor {options}") == 0
    out, err = capsys.readouterr()
    assert (out, err.splitlines()) == ("a is 1\n", said)
    assert talkative("doctor") == 0  # what one command was told does not hold for the next
    assert capsys.readouterr().err.splitlines() == ["a note", "warning: a warning"]


@pytest.mark.parametrize("command", ["doctor", "render r", "train --data d --out r", "demo"])
def test_json_is_the_result_and_nothing_else(
    command: str, talkative: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert talkative(f"{command} --json") == 0
    assert json.loads(capsys.readouterr().out) == {"a": [1]}


def test_json_of_a_command_that_fails_is_one_object(
    talkative: Gsdmsr, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    gsdmsr.failure = ThresholdError("psnr is 20")
    assert talkative("eval r --json") == 4
    out, err = capsys.readouterr()
    assert json.loads(out) == {"a": [1]}  # the result stands, the error is on stderr
    assert err.splitlines()[-1] == "error: psnr is 20"


@pytest.mark.parametrize(
    "line", ["train --json", "trian --json", "eval r --json --split x", "doctor --json --nonsense"]
)
def test_a_wrong_command_line_is_told_as_json_too(
    line: str, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gsdmsr(line) == 2
    out, err = capsys.readouterr()
    error = json.loads(out)["error"]
    assert (error["kind"], error["exit_code"]) == ("usage", 2)
    assert err == f"error: {error['message']}\n"


def test_the_log_file_gets_what_stderr_gets_with_times(
    talkative: Gsdmsr, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    log = tmp_path / "logs" / "a.log"
    assert talkative(f"doctor --log-file {log}") == 0
    gsdmsr.failure = DataError("no such thing")
    assert talkative(f"doctor -q --log-file {log}") == 3
    assert capsys.readouterr().err.splitlines()[-1] == "error: no such thing"
    lines = log.read_text(encoding="utf-8").splitlines()
    stamp = r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}[+-]\d\d:\d\d "
    assert all(re.match(stamp, line) for line in lines)
    texts = [re.sub(stamp, "", line) for line in lines]
    assert texts[:2] == ["a note", "warning: a warning"]
    assert texts[2:] == ["a note", "warning: a warning", "error: no such thing"]


def test_a_log_file_that_cannot_be_written_is_refused(
    talkative: Gsdmsr, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert talkative(f"doctor --log-file {tmp_path}") == 2
    assert f"--log-file {tmp_path}: cannot be written" in capsys.readouterr().err


def test_what_is_printed_steers_no_terminal(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with say.on_its_own():
        say.log_to(tmp_path / "log")
        say.note("a \x1b[2J name")
        say.result({}, "first\nsecond \x1b]0;x\x07")
    assert capsys.readouterr() == ("first\nsecond \\x1b]0;x\\x07\n", "a \\x1b[2J name\n")
    assert "\x1b" not in (tmp_path / "log").read_text()


def test_commands_within_a_command_do_not_answer_themselves(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for as_json in (True, False):
        with say.on_its_own(as_json):
            with say.parts() as answers:
                say.result({"part": 1}, "part 1")
            say.result({"whole": list(answers)}, "whole")
    decoder = json.JSONDecoder()
    out = capsys.readouterr().out
    document, end = decoder.raw_decode(out)
    assert document == {"whole": [{"part": 1}]}
    assert out[end:].split("\n")[1:] == ["part 1", "whole", ""]
