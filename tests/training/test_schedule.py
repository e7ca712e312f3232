"""Schedules and the clock they follow, in steps and in minutes."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.ground.progress import time_left
from gsdmsr_cli.options.preset import TrainingOptions
from gsdmsr_cli.training import schedule
from gsdmsr_cli.training.schedule import Clock, log_linear, new_clock

positive = st.floats(1e-9, 1e3)
unit = st.floats(0, 1)


class Time:
    """What time.perf_counter says, moved by hand [s]."""

    def __init__(self) -> None:
        self.now = 1000.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(schedule, "time", SimpleNamespace(perf_counter=time.perf_counter))
    return time


def test_log_linear_passes_through_the_ends_and_the_geometric_mean() -> None:
    assert log_linear((8e-3, 2e-5), 0.0) == pytest.approx(8e-3)
    assert log_linear((8e-3, 2e-5), 0.5) == pytest.approx(4e-4)
    assert log_linear((8e-3, 2e-5), 1.0) == pytest.approx(2e-5)


@given(positive, positive, unit, unit)
def test_log_linear_is_monotone_and_within_the_ends(a: float, b: float, p: float, q: float) -> None:
    low, high = sorted((p, q))
    early, late = log_linear((a, b), low), log_linear((a, b), high)
    tolerance = 1e-9 * max(a, b)
    assert min(a, b) - tolerance <= early <= max(a, b) + tolerance
    assert (late - early) * (b - a) >= -tolerance * abs(b - a)


@pytest.mark.parametrize("outside", [-3.0, 1.5])
def test_log_linear_is_clamped(outside: float) -> None:
    assert log_linear((1.0, 100.0), outside) == pytest.approx(1.0 if outside < 0 else 100.0)


def test_progress_counts_steps_without_a_budget(time: Time) -> None:
    clock = new_clock(TrainingOptions(steps=8))
    clock.start()
    time.now += 1e6
    assert clock.progress == 0
    found = []
    for clock.step in range(1, 11):
        found.append(clock.progress)
    assert found == [*(i / 8 for i in range(1, 8)), 1.0, 1.0, 1.0]


@pytest.mark.parametrize(("budget", "seconds"), [("90s", 90.0), ("2m", 120.0), ("1.5h", 5400.0)])
def test_progress_counts_wall_time_with_a_budget(time: Time, budget: str, seconds: float) -> None:
    clock = new_clock(TrainingOptions(steps=8, budget=budget))
    clock.step = 7  # without any say
    time.now += 50  # nor does what happens before the start
    assert clock.progress == clock.elapsed == 0
    clock.start()
    time.now += 0.25 * seconds
    assert clock.progress == pytest.approx(0.25)
    assert clock.elapsed == pytest.approx(0.25 * seconds)
    time.now += seconds
    assert clock.progress == 1.0
    assert clock.elapsed == pytest.approx(1.25 * seconds)


def test_early_phases_have_less_of_the_time_with_a_power_below_1(time: Time) -> None:
    clock = new_clock(TrainingOptions(budget="100s", budget_power=0.5))
    clock.start()
    for seconds, progress in ((4, 0.2), (21, 0.5), (56, 0.9), (19, 1.0), (100, 1.0)):
        time.now += seconds
        assert clock.progress == pytest.approx(progress)
    without = new_clock(TrainingOptions(steps=8, budget_power=0.5))
    without.step = 2
    assert without.progress == 0.25 and without.power == 1.0


@pytest.mark.parametrize("power", [0.4, 1.0, 2.0])
def test_what_is_left_of_a_budget_does_not_depend_on_the_power(time: Time, power: float) -> None:
    clock = new_clock(TrainingOptions(budget="100s", budget_power=power))
    clock.start()
    time.now += 30
    assert time_left(clock.elapsed, clock.progress, clock.power) == pytest.approx(70)
    assert time_left(0.0, 0.0, power) == 0.0


def test_time_of_earlier_sessions_counts(time: Time) -> None:
    clock = Clock(steps=10, budget=100.0, before=60.0)
    assert clock.elapsed == 60.0 and clock.progress == pytest.approx(0.6)
    clock.start()
    time.now += 20
    assert clock.elapsed == pytest.approx(80.0) and clock.progress == pytest.approx(0.8)


def test_one_preset_serves_steps_and_minutes(time: Time) -> None:
    """At the same progress a schedule has the same value, whatever progress counts."""
    rate: Callable[[Clock], float] = lambda clock: log_linear((1e-2, 1e-4), clock.progress)  # noqa: E731
    steps, minutes = Clock(200, None, step=50), Clock(10**9, 60.0)
    minutes.start()
    time.now += 15
    assert rate(steps) == pytest.approx(rate(minutes))
