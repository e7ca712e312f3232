"""What a long command says of its stages, and the times that it keeps."""

from __future__ import annotations

import io
import re
import time
from typing import Any

import pytest
from rich.console import Console

from gsdmsr_cli.commands import _stages_display
from gsdmsr_cli.commands._stages_display import StagesDisplay


def display(terminal: bool = False) -> tuple[StagesDisplay, io.StringIO]:
    text = io.StringIO()
    return StagesDisplay(Console(file=text, force_terminal=terminal, width=100)), text


def test_every_stage_has_its_time_and_the_sum_is_the_wall_time() -> None:
    started = time.perf_counter()
    shown, _ = display()
    for seconds in (0.03, 0.05):
        with shown.show("matching"):
            time.sleep(seconds)
    time.sleep(0.04)
    with pytest.raises(ValueError, match="x"), shown.show("mapping"):
        raise ValueError("x")
    found, total = shown.seconds(), time.perf_counter() - started
    assert list(found) == ["matching", "matching again", "mapping", "other"]
    assert found["matching"] >= 0.03 and found["matching again"] >= 0.05 and found["other"] >= 0.03
    assert sum(found.values()) == pytest.approx(total, abs=0.02)


def test_a_log_has_lines_at_the_begin_and_the_end_and_while_it_lasts(monkeypatch: Any) -> None:
    monkeypatch.setattr(_stages_display, "LINE_EVERY", 0.05)
    shown, text = display()
    with shown.show("matching [a]") as on_progress:
        on_progress(3, 12)
        time.sleep(0.12)
    with shown.show("mapping"):
        time.sleep(0.07)
    first, *between, last, again, mapping, end = text.getvalue().splitlines()
    assert first == "matching [a] ..." and re.fullmatch(r"matching \[a\]: 12 in 0\.\d s", last)
    line = r"matching \[a\]: 3 of 12, 0 s so far, about [01] s left"
    assert between and all(re.fullmatch(line, told) for told in between)
    assert again == "mapping ..." and mapping == "mapping: 0 s so far"
    assert re.fullmatch(r"mapping: in 0\.\d s", end)


def test_a_stage_that_fails_says_nothing_more(monkeypatch: Any) -> None:
    monkeypatch.setattr(_stages_display, "LINE_EVERY", 0.01)
    shown, text = display()
    with pytest.raises(KeyboardInterrupt), shown.show("mapping"):
        raise KeyboardInterrupt
    time.sleep(0.05)
    assert text.getvalue() == "mapping ...\n"


def test_a_terminal_shows_how_much_is_done_and_how_long_it_will_take() -> None:
    shown, text = display(terminal=True)
    with shown.show("matching") as on_progress:
        on_progress(3, 12)
        time.sleep(0.3)
    assert "matching" in text.getvalue() and "3/12" in text.getvalue()
    assert "left" in text.getvalue()
