"""What a training spends its time on is added up and returned once."""

from __future__ import annotations

import time

import pytest

from gsdmsr_cli.training.timings import TIMINGS, Stopwatch, timings_of


def test_time_is_added_up_by_name_until_it_is_taken() -> None:
    stopwatch = Stopwatch()
    for _ in range(2):
        with stopwatch.of("gradients"):
            time.sleep(0.02)
    with pytest.raises(ZeroDivisionError), stopwatch.of("optimizer"):
        time.sleep(0.01)
        raise ZeroDivisionError
    taken = stopwatch.take()
    assert tuple(taken) == TIMINGS
    assert 0.04 <= taken["gradients"] < 1 and 0.01 <= taken["optimizer"] < 1 and taken["save"] == 0
    assert not any(stopwatch.take().values())


def test_a_log_of_an_earlier_version_has_the_same_timings() -> None:
    seconds = {
        "gradients": 4.0,
        "optimizer": 3.0,
        "population": 2.0,
        "validation": 1.5,
        "save": 1.0,
    }
    before = dict(zip(("look", "learn", "grow", "watch", "save"), seconds.values(), strict=True))
    assert timings_of({"stages": before}) == timings_of({"timings": seconds}) == seconds
    assert timings_of({}) == {}
