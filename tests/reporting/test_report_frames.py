"""Which frames are shown, and that they are shown as they are."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from datasets import write_picture
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.reporting.frames import SCALES, SHOWN, choose, make_report_frames, scale_of
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View

scores = st.lists(st.one_of(st.none(), st.floats(0, 100)), min_size=1, max_size=30)


def level(value: float | None) -> float:
    return -1.0 if value is None else value


@given(scores)
def test_no_frame_is_left_out_that_is_worse_or_better(values: list[float | None]) -> None:
    worst, best = choose([{"psnr": value} for value in values])
    assert not set(worst) & set(best)
    assert len(worst) == min(SHOWN, (len(values) + 1) // 2)
    assert len(best) == min(SHOWN, len(values) - len(worst))
    ordered = sorted(map(level, values))
    assert [level(values[i]) for i in worst] == ordered[: len(worst)]
    assert [level(values[i]) for i in best] == ordered[::-1][: len(best)]


def test_nearly_all_errors_lie_below_the_scale() -> None:
    error = np.zeros((100, 100), np.float32)
    assert scale_of([error]) == SCALES[0]
    error[:30] = 0.09
    assert scale_of([error * 0, error]) == 0.1
    error[0, :40] = 1.0  # 0.4 % of the pixels
    assert scale_of([error]) == 0.1
    error[:2] = 1.0
    assert scale_of([error]) == 1.0
    assert scale_of([error * np.float32(np.nan)]) == 1.0  # of a broken render


class Painter:
    """Stands for a renderer: every picture is drawn half as bright as it is."""

    def __init__(self, pictures: Pictures) -> None:
        self.pictures = pictures

    def true(self, view: View) -> torch.Tensor:
        return self.pictures.load(view).permute(1, 2, 0).float() / 255

    def draw(self, view: View) -> torch.Tensor:
        return self.true(view) / 2


def pixels_of(url: str) -> np.ndarray:
    """Return the (H, W, 3) RGB pixels of a data URL, decoded by cv2."""
    kind, data = url.split(",", 1)
    assert kind == "data:image/webp;base64"
    raw = np.frombuffer(base64.b64decode(data), np.uint8)
    return cv2.imdecode(raw, cv2.IMREAD_COLOR)[..., ::-1].astype(float)


@pytest.fixture
def view(tmp_path: Path) -> View:
    """A picture of 900 x 600 px, orange on the left and grey on the right."""
    pixels = np.full((600, 900, 3), 120, np.uint8)
    pixels[:, :450] = (240, 140, 40)
    write_picture(tmp_path / "a.png", pixels)
    camera = Camera(np.eye(4), 500.0, 500.0, 450.0, 300.0, 900, 600)
    return View("a", camera, 0.0, "test", tmp_path / "a.png")


def test_pictures_are_those_that_were_compared(view: View) -> None:
    renderer: Any = Painter(Pictures((1.0, 1.0, 1.0), 1, 1 << 24))
    views = [view, replace(view, name="b")]
    shown, full = make_report_frames(renderer, views, [{"psnr": 30.0}, {"psnr": 20.0}])
    assert [(frame.index, frame.worst) for frame in shown] == [(1, True), (0, False)]
    assert full == 0.5  # the errors are 70 / 255 and 60 / 255
    for frame in shown:
        assert (frame.width, frame.height) == (800, 533)
        for url, bright in ((frame.true, 1.0), (frame.drawn, 0.5)):
            found = pixels_of(url)
            assert found.shape == (533, 800, 3)
            expected = np.array([(240, 140, 40), (120, 120, 120)]) * bright
            assert np.abs(found[100:400, [200, 600]].mean(0) - expected).max() < 4
        left, right = pixels_of(frame.error)[100:400, [200, 600]].mean(0)
        assert np.abs(left - right).max() > 20  # another error, another colour
        assert pixels_of(frame.thumbnail).shape == (64, 96, 3)


def test_four_of_the_worst_and_four_of_the_best_are_shown() -> None:
    frames = [{"psnr": float(psnr)} for psnr in (5, 9, 1, 7, 3, 8, 2, 6, 4, 10)]
    assert choose(frames) == ([2, 6, 4, 8], [9, 1, 5, 3])
    assert choose(frames[:3]) == ([2, 0], [1])
