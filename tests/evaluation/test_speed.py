"""Frames a second, by a clock that a fake engine and a fake model move."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.evaluation.speed import SECONDS, SHOTS, WARM_UP, measure_speed
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.scene.camera import Camera

DRAW_S, MOVE_S = 0.02, 0.03


class Stage:
    """A model and an engine that take a known time, and remember what they were asked for."""

    def __init__(self) -> None:
        self.now = 5.0
        self.moments: list[float] = []
        self.drawn: list[tuple[float, Camera]] = []

    def perf_counter(self) -> float:
        return self.now

    def instant(self, time: float, camera: Camera) -> Instant:
        return Instant(time, camera)

    def shares(self, instant: Instant) -> Any:
        return [SimpleNamespace(weight=1.0, model=self, instant=instant)]

    def at(self, instant: Instant) -> Any:
        assert not torch.is_grad_enabled()
        self.now += MOVE_S
        self.moments.append(instant.time)
        return SimpleNamespace(splats=instant.time)

    def as_seen(self, moment: Any, instant: Instant) -> Any:
        """Be asked of every moment before it is drawn."""
        assert moment.splats == instant.time
        return moment

    def rasterize(self, moment: Any, camera: Camera, background: Any, *rest: Any) -> str:
        self.now += DRAW_S
        self.drawn.append((moment.splats, camera))
        return f"frame {len(self.drawn)}"

    def shade(self, frame: str, instant: Instant) -> str:
        """Be asked of every frame right after it has been drawn, at its own instant."""
        assert frame == f"frame {len(self.drawn)}"
        assert (instant.time, instant.camera) == self.drawn[-1]
        return frame


def measured(stage: Stage, shots: list[tuple[Camera, float]]) -> speed.Speed:
    whoever: Any = stage
    return measure_speed(whoever, shots, whoever, torch.zeros(3))


@pytest.fixture
def stage(monkeypatch: pytest.MonkeyPatch) -> Stage:
    stage = Stage()
    monkeypatch.setattr(speed, "time", SimpleNamespace(perf_counter=stage.perf_counter))
    return stage


def shots_of(count: int) -> list[tuple[Camera, float]]:
    cameras = [Camera(np.eye(4), 1.0, 1.0, 1.0, 1.0, 2 + i, 2) for i in range(count)]
    return [(camera, i / count) for i, camera in enumerate(cameras)]


@pytest.mark.parametrize("count", [1, 5, 16, 17, 100])
def test_rates_are_those_of_the_clock(stage: Stage, count: int) -> None:
    found = measured(stage, shots_of(count))
    assert found.fps == pytest.approx(1 / (MOVE_S + DRAW_S))
    assert found.fps_raster == pytest.approx(1 / DRAW_S)
    assert found.frames == pytest.approx(SECONDS / (MOVE_S + DRAW_S), abs=1)
    assert found.document() == {
        "fps": found.fps,
        "fps_raster": found.fps_raster,
        "frames": found.frames,
        "warm_up_frames": WARM_UP,
    }


@pytest.mark.parametrize("count", [3, 16, 100])
def test_shots_are_drawn_in_turn_each_with_its_moment(stage: Stage, count: int) -> None:
    shots = shots_of(count)
    measured(stage, shots)
    moments = {camera: moment for camera, moment in shots}
    assert all(moments[camera] == moment for moment, camera in stage.drawn)
    different = sorted(set(stage.moments))
    assert min(count, SHOTS // 2) <= len(different) <= min(count, SHOTS)
    steps = np.diff(different)
    assert steps == pytest.approx(np.full(len(steps), steps[0]))  # all over the film
    assert different[-1] + steps[0] >= 1 - 1e-9


def test_what_has_only_been_asked_for_counts_once_it_is_there(stage: Stage) -> None:
    """A device that takes orders at once, and has done them when it is waited for."""
    ordered: list[int] = []

    def wait() -> None:
        stage.now += DRAW_S * len(ordered)
        ordered.clear()

    def draw(i: int) -> None:
        stage.now += 0.01
        ordered.append(i)

    rate, frames = speed._rate(draw, 7, wait)
    assert frames == pytest.approx(SECONDS / 0.01, abs=1)
    assert rate == pytest.approx(1 / (0.01 + DRAW_S))


def test_slow_drawing_sees_every_shot_once(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "SECONDS", 0.0)
    assert measured(stage, shots_of(7)).frames == 7
