"""Timing in turns, on a clock that the timed functions move by themselves."""

from __future__ import annotations

import pytest

from gsdmsr_cli.benchmark import timing


class Clock:
    def __init__(self) -> None:
        self.now = 0.0
        self.order: list[str] = []

    def __call__(self) -> float:
        return self.now

    def taking(self, name: str, seconds: list[float]) -> None:
        """Be a call of ``name``; the last of the seconds stands for all further calls."""
        self.order.append(name)
        self.now += seconds.pop(0) if len(seconds) > 1 else seconds[0]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(timing.time, "perf_counter", clock)
    return clock


def test_a_call_is_timed_without_its_compilation(clock: Clock) -> None:
    seconds = [30.0, 0.05]
    times = timing.in_turns({"slow at first": lambda: clock.taking("a", seconds)})
    assert times["slow at first"] == pytest.approx(50)


def test_functions_take_turns_of_a_quarter_of_a_second(clock: Clock) -> None:
    functions = {
        "a": lambda: clock.taking("a", [0.05]),
        "b": lambda: clock.taking("b", [0.125]),
    }
    assert timing.in_turns(functions, rounds=3) == pytest.approx({"a": 50, "b": 125})
    assert "".join(clock.order) == "aabb" + 3 * "aaaaabb"


def test_a_slow_function_is_called_once_a_turn(clock: Clock) -> None:
    timing.in_turns({"a": lambda: clock.taking("a", [9.0])}, rounds=2)
    assert len(clock.order) == 4


def test_a_disturbed_round_does_not_count(clock: Clock) -> None:
    seconds = [0.25, 0.25, 0.25, 7.0, 0.25, 0.25]
    assert timing.in_turns({"a": lambda: clock.taking("a", seconds)}, 5)["a"] == pytest.approx(250)
