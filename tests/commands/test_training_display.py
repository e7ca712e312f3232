"""What the progress of a training looks like, on a terminal and in a log."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._training_display import TrainingDisplay, describe
from gsdmsr_cli.ground import say
from gsdmsr_cli.training.loop import Report

REPORT = Report(2588, 38.0, 0.63, 0.1, 6574, 1.0, 0.0, 0, 16.6, 29.763, "val", {})


def test_a_report_is_one_line() -> None:
    line = " 63%  step 2588  val PSNR 29.76  6574 splats  16.6 ms/step  0:22 left"
    assert describe(REPORT) == line
    assert describe(replace(REPORT, psnr=None, split="train")).split("  ")[2] == "train PSNR none"
    assert describe(replace(REPORT, elapsed=38_000.0)).endswith("  6:11:57 left")


def test_dropped_splats_are_told_where_there_are_any() -> None:
    assert "  6574 splats (2 dropped)  " in describe(replace(REPORT, dropped=2))


def shown(reports: int, terminal: bool) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=120)
    with TrainingDisplay(console) as display:
        for i in range(1, reports + 1):
            display.show(replace(REPORT, progress=i / reports, step=i))
    return out.getvalue()


@pytest.mark.parametrize("terminal", [True, False])
def test_a_log_gets_one_line_in_twenty_and_the_last(
    terminal: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with say.on_its_own():
        say.log_to(tmp_path / "log")
        shown(200, terminal)
    logged = [line.partition(" ")[2] for line in (tmp_path / "log").read_text().splitlines()]
    lines = logged if terminal else capsys.readouterr().err.splitlines()
    assert len(lines) == 20 + 1 and lines == logged
    assert "step 1 " in lines[0] and lines[-1].startswith("100%  step 200 ")


def test_quiet_shows_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with say.on_its_own():
        say.speak_up_to(say.WARNINGS)
        assert shown(3, terminal=True) + shown(3, terminal=False) == ""
    assert capsys.readouterr() == ("", "")


def test_a_terminal_gets_a_bar() -> None:
    text = shown(3, terminal=True)
    assert "training" in text and "100%  step 3  val PSNR 29.76" in text


@pytest.mark.parametrize(("level", "lines"), [(say.DETAILS, 1), (say.NOTES, 0)])
def test_verbose_says_how_long_a_piece_of_work_took(
    level: int, lines: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with say.on_its_own():
        say.speak_up_to(level)
        with progress_bar("reading [a] scene") as on_progress:
            on_progress(1, 2)
    err = capsys.readouterr().err
    assert len(re.findall(r"^reading \[a\] scene: 0\.\d s$", err, re.M)) == lines
