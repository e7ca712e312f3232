"""Segments of time: they cover all of it, go over into each other, and a scene is cut by them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest
from datasets import write_dnerf
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.segments import Segment, between, cut, weights

counts = st.integers(1, 12)
overlaps = st.floats(0, 0.49)
times = st.floats(0, 1)


def test_closed_forms() -> None:
    assert cut(1, 0.3) == [Segment(0.0, 1.0)]
    assert cut(2, 0.0) == [Segment(0.0, 0.5), Segment(0.5, 1.0)]
    first, second = cut(2, 0.4)  # 2 L - 0.4 L = 1
    assert (first.end, second.start) == pytest.approx((0.625, 0.375))
    assert weights(0.375, [first, second]) == {0: 1.0}
    assert weights(0.5, [first, second]) == pytest.approx({0: 0.5, 1: 0.5})
    assert weights(0.625, [first, second]) == pytest.approx({1: 1.0})
    assert weights(0.5, cut(2, 0.0)) == {1: 1.0}


@given(counts, overlaps)
def test_segments_cover_the_time_and_are_of_equal_length(count: int, overlap: float) -> None:
    segments = cut(count, overlap)
    assert len(segments) == count
    assert (segments[0].start, segments[-1].end) == (0.0, 1.0)
    lengths = [segment.end - segment.start for segment in segments]
    assert lengths == pytest.approx([lengths[0]] * count)
    for before, after in itertools.pairwise(segments):
        assert before.end - after.start == pytest.approx(overlap * lengths[0], abs=1e-9)
    assert all(b.end <= a.start + 1e-9 for b, a in zip(segments, segments[2:], strict=False))


@given(counts, overlaps, times)
def test_those_that_count_hold_the_time_and_their_weights_add_up(
    count: int, overlap: float, time: float
) -> None:
    segments = cut(count, overlap)
    counting = weights(time, segments)
    assert 1 <= len(counting) <= 2
    assert sum(counting.values()) == pytest.approx(1)
    assert all(segments[i].holds(time) and weight > 0 for i, weight in counting.items())


@given(counts, st.floats(0.05, 0.49), times)
def test_weights_do_not_jump(count: int, overlap: float, time: float) -> None:
    segments, step = cut(count, overlap), 1e-5
    before, after = weights(time, segments), weights(min(time + step, 1), segments)
    most = step / (overlap / count)  # a weight goes from 0 to 1 within an overlap
    for i in before.keys() | after.keys():
        assert abs(before.get(i, 0) - after.get(i, 0)) <= 2 * most


def test_times_beyond_the_ends_are_those_of_the_ends() -> None:
    segments = [Segment(0.2, 0.5), Segment(0.4, 0.8)]
    assert weights(0.0, segments) == {0: 1.0}
    assert weights(1.0, segments) == {1: 1.0}
    assert Segment(0.2, 0.6).within(0.1) == 0
    assert Segment(0.2, 0.6).within(0.5) == pytest.approx(0.75)


def test_a_scene_is_cut(tmp_path: Path) -> None:
    scene = read_scene(write_dnerf(tmp_path, train=5, val=2, test=3))
    scene = replace(scene, duration=8.0)
    assert between(scene, 0.0, 1.0) is scene
    part = between(scene, 0.25, 0.75)
    assert [view.time for view in part.split("train")] == pytest.approx([0, 0.5, 1])
    assert [view.name for view in part.split("train")] == [
        view.name for view in scene.split("train")[1:4]
    ]
    assert [view.time for view in part.split("test")] == pytest.approx([0.5])
    assert part.duration == pytest.approx(4)
    with pytest.raises(DataError, match=r"no train view lies between 0\.3 and 0\.4 of its time"):
        between(scene, 0.3, 0.4)
