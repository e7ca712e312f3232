"""Flicker of consecutive pictures: closed forms, which pairs there are, and why there is none."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from datasets import write_picture
from torch import Tensor
from view_checks import SIZE, camera_at, shifted_pictures, views_of

from gsdmsr_cli.evaluation.flicker import Flicker, consecutive, figures, measure_flicker
from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.pictured_flow import PicturedFlow
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View

TIMES = [i / 5 for i in range(6)]


@dataclass(frozen=True, eq=False)
class Known(ViewRenderer):
    """Draws the true pictures, changed."""

    change: Callable[[Tensor, View], Tensor] = lambda picture, _: picture

    def draw(self, view: View) -> Tensor:
        return self.change(self.true(view), view)


def renderer_of(pictures: Pictures, change: Any = lambda picture, _: picture) -> Known:
    nothing: Any = None
    return Known(nothing, nothing, pictures, torch.ones(3), change)


def found_of(renderer: ViewRenderer, views: list[View]) -> Flicker:
    pairs = consecutive(views, views)
    assert not isinstance(pairs, Missing)
    found = measure_flicker(renderer, pairs, lambda done: None)
    assert isinstance(found, Flicker)
    return found


@pytest.fixture
def still(tmp_path: Path) -> tuple[Pictures, list[View]]:
    """Views of a camera that stands before something that does not move."""
    pictures, (view, _) = shifted_pictures(tmp_path)
    return pictures, [replace(view, name=str(i), time=time) for i, time in enumerate(TIMES)]


def brighter(by: float) -> Callable[[Tensor, View], Tensor]:
    """Return what adds so much to every other view."""
    return lambda picture, view: 0.5 * picture + by * (int(view.name) % 2)


@pytest.mark.parametrize("by", [0.0, 0.01, 0.125, 0.4])
def test_alternating_brightness_flickers_by_its_amplitude(
    still: tuple[Pictures, list[View]], by: float
) -> None:
    pictures, views = still
    found = found_of(renderer_of(pictures, brighter(by)), views)
    assert (found.true, found.pairs, found.pixels) == (0.0, 5, 1.0)
    assert found.drawn == pytest.approx(by, abs=1e-6)


def test_brightness_beyond_what_can_be_shown_does_not_count(
    still: tuple[Pictures, list[View]],
) -> None:
    pictures, views = still
    white = renderer_of(pictures, lambda picture, view: picture + 1 + int(view.name))
    assert found_of(white, views).drawn == 0.0


def test_what_moves_as_in_the_truth_does_not_flicker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a flow of exactly 3 px to the right, which is that of the pictures."""
    pictures, views = shifted_pictures(tmp_path, by=3)
    flow = np.zeros((SIZE, SIZE, 2), np.float32)
    flow[..., 0] = 3
    flow[:, -3:] = np.nan
    monkeypatch.setattr(PicturedFlow, "between", lambda *_: flow)
    found = found_of(renderer_of(pictures), views)
    assert found.true == found.drawn == 0.0
    assert found.pixels == pytest.approx(1 - 3 / SIZE)
    frozen = renderer_of(pictures, lambda *_: pictures.load(views[0]).permute(1, 2, 0) / 255)
    first = pictures.load(views[0]).permute(1, 2, 0).double() / 255
    expected = float((first[:, :-3] - first[:, 3:]).abs().mean())
    assert found_of(frozen, views).drawn == pytest.approx(expected, abs=1e-6)


def test_the_flow_is_that_of_the_true_pictures(tmp_path: Path) -> None:
    """Its sixteenths of a pixel leave a little of what differs without it."""
    pictures, views = shifted_pictures(tmp_path, by=3)
    found = found_of(renderer_of(pictures), views)
    first, second = (pictures.load(view).double() / 255 for view in views)
    assert found.drawn == found.true < 0.1 * float((first - second).abs().mean())
    assert 0.8 < found.pixels < 1


def test_pixels_that_a_mask_leaves_out_do_not_count(
    still: tuple[Pictures, list[View]], tmp_path: Path
) -> None:
    pictures, views = still
    white = np.zeros((SIZE, SIZE, 1), np.uint8)
    white[:, : SIZE // 4] = 255
    write_picture(tmp_path / "mask.png", white)
    views = [replace(view, signals={"mask": tmp_path / "mask.png"}) for view in views]

    def left_alone(picture: Tensor, view: View) -> Tensor:
        changed = brighter(0.3)(picture, view)
        changed[:, : SIZE // 4] = 0.5
        return changed

    found = found_of(renderer_of(pictures, left_alone), views)
    assert (found.drawn, found.pixels) == (0.0, 0.25)


def names_of(pairs: object) -> list[tuple[str, str]]:
    assert isinstance(pairs, list)
    return [(one.name, other.name) for one, other in pairs]


def test_a_pair_goes_on_from_the_one_before_it() -> None:
    views = views_of([camera_at(4, 0), camera_at(0, 4)], [0.0, 0.5, 1.0], Path())
    by_moment = sorted(views, key=lambda view: view.time)
    expected = [("0_0", "0_1"), ("0_1", "0_2"), ("1_0", "1_1"), ("1_1", "1_2")]
    assert names_of(consecutive(by_moment, by_moment)) == expected


def test_views_that_were_trained_on_are_neighbours_of_those_held_out() -> None:
    views = views_of([camera_at(4, 0)], TIMES, Path())
    held_out = [replace(views[2], split="test")]
    scene = [*views[:2], *held_out, *views[3:]]
    assert names_of(consecutive(held_out, scene)) == [("0_1", "0_2"), ("0_2", "0_3")]


def test_cameras_that_jump_have_no_flicker_and_the_reason_is_said(tiny_scene: Path) -> None:
    scene = read_scene(tiny_scene)
    missing = consecutive(scene.split("test"), scene.views)
    assert isinstance(missing, Missing)
    found = figures(missing)
    assert found.keys() == {"flicker"} and found["flicker"]["value"] is None
    assert found["flicker"]["reason"].startswith("0 of 4 views have a neighbour: one of the moment")


def test_no_view_is_drawn_twice(still: tuple[Pictures, list[View]]) -> None:
    pictures, views = still
    drawn: list[str] = []

    def note(picture: Tensor, view: View) -> Tensor:
        drawn.append(view.name)
        return picture

    found_of(renderer_of(pictures, note), views)
    assert drawn == [view.name for view in views]


def test_small_pictures_and_such_without_flow_have_a_reason(
    still: tuple[Pictures, list[View]], monkeypatch: pytest.MonkeyPatch
) -> None:
    _, views = still
    pairs = consecutive(views, views)
    assert isinstance(pairs, list)
    small = measure_flicker(renderer_of(Pictures((1, 1, 1), 3, 1 << 20)), pairs, lambda _: None)
    assert isinstance(small, Missing)
    assert small.reason == "pictures of 21 x 21 px; optical flow needs 32 px a side"
    nowhere = np.full((SIZE, SIZE, 2), np.nan, np.float32)
    monkeypatch.setattr(PicturedFlow, "between", lambda *_: nowhere)
    none = measure_flicker(renderer_of(still[0]), pairs, lambda _: None)
    assert isinstance(none, Missing) and none.reason.startswith("no pixel counts whose optical")


def test_a_render_with_nan_has_no_value(still: tuple[Pictures, list[View]]) -> None:
    pictures, views = still
    broken = renderer_of(pictures, lambda picture, _: picture * math.nan)
    found = figures(found_of(broken, views))
    assert found["flicker"] == {
        "value": None, "reason": "not a number in at least one frame", "searched": [],
    }  # fmt: skip


def test_the_excess_is_what_the_truth_does_not_have() -> None:
    found = figures(Flicker(0.03, 0.02, 4, 0.9))
    values = {name: entry["value"] for name, entry in found.items()}
    expected = {"flicker": 0.03, "flicker_true": 0.02, "flicker_excess": 0.01}
    assert values == pytest.approx(expected)
