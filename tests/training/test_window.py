"""Which views a training may see yet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from balls import Album, cameras, scene_of
from hypothesis import given
from hypothesis import strategies as st
from training_checks import preset_of, trainer_of

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import TrainingOptions
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.window import Window, start_window

TIMES = [0.9, 0.1, 0.5, 0.3, 0.7, 0.4]


def seen(window: Window, progress: float, count: int = len(TIMES)) -> list[int]:
    return [row for row in range(count) if window.shows(row, progress)]


def test_it_grows_evenly_from_the_views_about_its_moment() -> None:
    options = TrainingOptions(window=1 / 3, window_until=0.5, window_at=0.35, static_until=0.1)
    window = Window(TIMES, options)
    assert seen(window, 0.0) == seen(window, 0.1) == [3, 5]  # 0.3 and 0.4
    assert seen(window, 0.2) == [2, 3, 5]
    assert seen(window, 0.3) == [1, 2, 3, 5]
    assert seen(window, 0.49) == seen(window, 0.5) == seen(window, 1.0) == [*range(6)]


def test_all_are_seen_from_the_start_unless_it_is_asked_for() -> None:
    assert seen(Window(TIMES, TrainingOptions()), 0.0) == [*range(6)]
    assert seen(Window(TIMES, TrainingOptions(window=0.1, window_until=0.0)), 0.0) == [*range(6)]


def test_all_views_of_a_single_moment_are_seen_from_the_start() -> None:
    window = Window([0.3] * 6, TrainingOptions(window=0.1, window_newest=1.0))
    assert seen(window, 0.0) == [*range(6)] and window.extent(0.0) is None
    assert set(newest(window, 0.0)) == {None}


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=20),
    st.floats(0.001, 1), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1),
)  # fmt: skip
def test_nearer_views_come_first_and_none_goes_again(
    times: list[float], first: float, until: float, at: float, one: float, two: float
) -> None:
    window = Window(times, TrainingOptions(window=first, window_until=until, window_at=at))
    before, after = (seen(window, p, len(times)) for p in sorted((one, two)))
    assert before and set(before) <= set(after)
    hidden = [abs(t - at) for row, t in enumerate(times) if row not in before]
    assert not hidden or max(abs(times[row] - at) for row in before) <= min(hidden)


def moments(count: int) -> Scene:
    """Return a scene with a view of each of so many moments."""
    scene = scene_of(cameras(count, 16))
    times = [row / (count - 1) for row in range(count)]
    views = (replace(view, time=at) for view, at in zip(scene.views, times, strict=True))
    return replace(scene, views=tuple(views))


def newest(window: Window, progress: float, draws: int = 400) -> list[int | None]:
    generator = torch.Generator().manual_seed(1)
    return [window.draw_newest(progress, generator) for _ in range(draws)]


def test_the_views_that_came_last_may_be_drawn_oftener() -> None:
    """Of 40 views that grow from one end of time, the last four of those that are seen."""
    times = [row / 39 for row in range(40)]
    options = TrainingOptions(
        window=0.05, window_until=1.0, window_at=0.0, static_until=0.0, window_newest=0.5
    )
    window = Window(times, options)
    drawn = newest(window, 0.5)
    count = len(seen(window, 0.5, 40))
    assert set(drawn) == {None, *range(count - 4, count)}
    assert 160 <= drawn.count(None) <= 240, "one in two"
    assert set(newest(window, 0.0)) == {None, 0, 1}, "there are two"
    assert set(newest(window, 1.0)) == {None}, "all are seen"
    rarely = Window(times, TrainingOptions(window=0.05, window_until=1.0, window_at=0.0))
    before = (generator := torch.Generator()).get_state()
    assert rarely.draw_newest(0.5, generator) is None
    assert torch.equal(generator.get_state(), before), "older runs draw what they did"


def test_extent_is_that_of_the_times_that_are_seen() -> None:
    window = Window(TIMES, TrainingOptions(window=0.5, window_until=1.0, window_at=0.5))
    assert window.extent(0.0) == (0.4, 0.7)
    assert window.extent(0.04) == (0.4, 0.7), "nothing moves before 0.04"
    assert window.extent(0.5) == (0.3, 0.9) and window.extent(1.0) is None
    assert Window(TIMES, TrainingOptions()).extent(0.0) is None


def test_a_training_holds_what_it_has_not_seen_and_nothing_later(tiny_scene: Path) -> None:
    options = "training.window=0.25", "training.window_until=0.5", "training.window_at=0.0"
    wanted = preset_of(
        *options, "training.window_if=always", "training.static_until=0", "training.steps=20"
    )
    trainer = trainer_of(tiny_scene, wanted)
    grids = [p for p in trainer.model.parameters() if p.time_axis is not None]
    assert grids
    with torch.no_grad():
        for grid in grids:
            grid.tensor.copy_(torch.rand(grid.tensor.shape, generator=torch.Generator()))
    trainer._enter_phase(0.0)
    for grid in grids:
        at = grid.tensor.detach().movedim(grid.time_axis or 0, 0)
        assert torch.equal(at[-1], at[-2]) and not torch.equal(at[0], at[-1])
    kept = [grid.tensor.detach().clone() for grid in grids]
    with torch.no_grad():
        for grid in grids:
            grid.tensor.add_(torch.rand(grid.tensor.shape, generator=torch.Generator()))
    changed = [grid.tensor.detach().clone() for grid in grids]
    trainer._enter_phase(0.5)
    for grid, now, before in zip(grids, changed, kept, strict=True):
        assert torch.equal(grid.tensor.detach(), now) and not torch.equal(now, before)


def test_a_training_sees_no_other_views(tiny_scene: Path) -> None:
    options = "training.window=0.25", "training.window_until=1.0", "training.window_at=0.0"
    further = "training.window_if=always", "training.static_until=0"
    trainer = trainer_of(tiny_scene, preset_of(*options, *further))
    times = sorted(view.time for view in trainer.views)
    for progress, count in ((0.0, 3), (0.5, 8), (1.0, 12)):
        rows = {trainer._next_row(progress) for _ in range(200)}
        assert {trainer.views[row].time for row in rows} == set(times[:count])


def test_a_training_draws_what_came_last(tiny_scene: Path) -> None:
    options = "training.window=0.5", "training.window_until=1.0", "training.window_at=0.0"
    further = "training.window_if=always", "training.static_until=0", "training.window_newest=1"
    trainer = trainer_of(tiny_scene, preset_of(*options, *further))
    times = sorted(view.time for view in trainer.views)
    rows = {trainer._next_row(0.0) for _ in range(50)}
    assert {trainer.views[row].time for row in rows} == set(times[4:6]), "2 of 12 are a tenth"
    rows = {trainer._next_row(1.0) for _ in range(200)}
    assert {trainer.views[row].time for row in rows} == set(times)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("training.window=0", "window is 0.0; allowed: a share above 0, up to 1"),
        ("training.window_at=1.5", "window_at is 1.5; allowed: a time from 0 to 1"),
        ("training.window_until=2", "window_until"),
    ],
)
def test_what_cannot_be_is_refused(option: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        preset_of(option)


@pytest.mark.parametrize(
    ("share", "seen_at_first", "told"), [(0.0, 16, False), (0.05, 16, False), (0.11, 4, True)]
)
def test_if_apart_it_depends_on_what_the_views_show(
    share: float, seen_at_first: int, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsdmsr_cli.training.window.views_with_things_apart", lambda *_: share)
    options = TrainingOptions(window=0.25, window_if="apart")
    window = start_window(moments(16), Album([]), torch.ones(3), options)
    assert len(seen(window, 0.0, 16)) == seen_at_first
    assert (window.note is not None) == told
    assert not told or "in 11% of the train views" in str(window.note)


def test_always_asks_nothing_of_the_pictures() -> None:
    options = TrainingOptions(window=0.25, window_if="always")
    window = start_window(moments(16), Album([]), torch.ones(3), options)
    assert len(seen(window, 0.0, 16)) == 4 and window.note is None
