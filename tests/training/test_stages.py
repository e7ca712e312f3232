"""What a training spends its time on is counted once and told once."""

from __future__ import annotations

import time

import pytest

from gsdmsr_cli.training.stages import STAGES, Stopwatch


def test_time_is_added_up_by_stage_until_it_is_taken() -> None:
    stopwatch = Stopwatch()
    for _ in range(2):
        with stopwatch.of("look"):
            time.sleep(0.02)
    with pytest.raises(ZeroDivisionError), stopwatch.of("learn"):
        time.sleep(0.01)
        raise ZeroDivisionError
    taken = stopwatch.take()
    assert tuple(taken) == STAGES
    assert 0.04 <= taken["look"] < 1 and 0.01 <= taken["learn"] < 1 and taken["save"] == 0
    assert not any(stopwatch.take().values())
