"""Output that cannot be written: work goes on to its end, and the exit code says what was lost."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from sinks import SINKS, sink

COMMAND = """
import sys
from pathlib import Path
from types import SimpleNamespace
from rich.console import Console
from gsdmsr_cli import commands
from gsdmsr_cli.cli.main import main
from gsdmsr_cli.ground.errors import DataError, ThresholdError

done, ending = Path(sys.argv[1]), sys.argv[2]

def run(*_):
    for number in range(3000):
        Console().print("a result", number)
        Console(stderr=True).print("how far it is", number)
    done.write_text("whole")
    print("one more")
    if ending == "missed":
        raise ThresholdError("psnr is 1")
    if ending == "bad":
        raise DataError("a.png: truncated")

commands.doctor = SimpleNamespace(run=run)
sys.argv = ["gsdmsr", "doctor"]
main()
"""
"""A command that prints, writes its file, and prints again."""


def run(done: Path, ending: str, out: int, err: int) -> subprocess.CompletedProcess[bytes]:
    command = [sys.executable, "-c", COMMAND, str(done), ending]
    return subprocess.run(command, stdout=out, stderr=err, timeout=60, check=False)


@pytest.mark.parametrize(("ending", "code"), [("well", 0), ("missed", 4), ("bad", 3)])
@pytest.mark.parametrize("stream", ["out", "err", "both"])
def test_a_reader_that_has_left_changes_nothing(
    tmp_path: Path, stream: str, ending: str, code: int
) -> None:
    done = tmp_path / "done"
    with sink(SINKS[0]) as pipe:
        out = subprocess.PIPE if stream == "err" else pipe
        err = subprocess.PIPE if stream == "out" else pipe
        ended = run(done, ending, out, err)
    assert ended.returncode == code and done.read_text() == "whole"
    if stream == "err":
        assert ended.stdout.endswith(b"a result 2999\none more\n")
    if stream == "out":
        assert ended.stderr.count(b"error: ") == (ending != "well")
        assert b"Traceback" not in ended.stderr and b"Exception" not in ended.stderr


@pytest.mark.parametrize(("ending", "code"), [("well", 3), ("missed", 4), ("bad", 3)])
def test_results_that_nobody_gets_are_an_error(tmp_path: Path, ending: str, code: int) -> None:
    with sink(SINKS[1]) as full:
        ended = run(tmp_path / "done", ending, full, subprocess.PIPE)
    assert ended.returncode == code and (tmp_path / "done").read_text() == "whole"
    last = ended.stderr.splitlines()[-1].decode()
    said = {"missed": "psnr is 1", "bad": "a.png: truncated"}
    expected = "standard output cannot be written: No space left on device; what was asked for is "
    assert last.startswith(f"error: {said.get(ending, expected)}")


def test_notes_that_nobody_gets_are_none(tmp_path: Path) -> None:
    with sink(SINKS[1]) as full:
        ended = run(tmp_path / "done", "well", subprocess.PIPE, full)
    assert ended.returncode == 0 and ended.stdout.endswith(b"one more\n")


def test_characters_that_the_terminal_has_not_are_written_as_codes(tmp_path: Path) -> None:
    code = COMMAND.replace('"one more"', '"Stra\\u00dfe \\u2192 \\udcff"')
    environment = os.environ | {"PYTHONIOENCODING": "latin-1:strict"}
    command = [sys.executable, "-c", code, str(tmp_path / "done"), "well"]
    ended = subprocess.run(command, capture_output=True, env=environment, timeout=60, check=False)
    assert ended.returncode == 0
    assert ended.stdout.endswith(b"Stra\xdfe \\u2192 \\udcff\n")


@pytest.mark.skipif(sys.platform == "win32", reason="descriptors of files are not numbered so")
def test_files_do_not_get_the_numbers_of_closed_streams(tmp_path: Path) -> None:
    code = COMMAND.replace('print("one more")', 'print(done.open().fileno(), file=done.open("a"))')
    command = [sys.executable, "-c", code, str(tmp_path / "done"), "well"]
    closed = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *command]
    assert subprocess.run(closed, timeout=60, check=False).returncode == 0
    assert (tmp_path / "done").read_text() == "whole3\n"
