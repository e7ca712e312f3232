"""Line charts: well-formed, with every line inside the axes and round numbers at them."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsdmsr_cli.ground.charts import COLOURS, HEIGHT, WIDTH, Line, _ticks, line_chart

SVG = "{http://www.w3.org/2000/svg}"


def paths_of(chart: str) -> list[tuple[str, list[tuple[float, float]]]]:
    """Return colour and places of every line."""
    found = []
    for path in ElementTree.fromstring(chart).iter(f"{SVG}path"):
        if path.get("class") != "grid":
            numbers = [float(n) for n in re.findall(r"-?[\d.]+", path.get("d") or "")]
            places = list(zip(numbers[::2], numbers[1::2], strict=True))
            found.append((path.get("stroke") or "", places))
    return found


def test_lines_of_one_name_share_a_colour_and_a_legend() -> None:
    steps = [(0.0, 1.0), (1.0, 2.0)]
    chart = line_chart("t", "x", "y", [Line("a", steps), Line("b & <c>", steps), Line("a", steps)])
    assert [colour for colour, _ in paths_of(chart)] == [COLOURS[0], COLOURS[1], COLOURS[0]]
    texts = [text.text for text in ElementTree.fromstring(chart).iter(f"{SVG}text")]
    assert texts.count("a") == 1 and texts.count("b & <c>") == 1


def test_the_corners_of_a_line_lie_where_the_ticks_say() -> None:
    chart = line_chart("t", "x", "y", [Line("a", [(0.0, 20.0), (8.0, 32.0)])])
    ((_, ((x0, y0), (x1, y1))),) = paths_of(chart)
    assert x0 < x1 and y0 > y1
    texts = {t.text: t for t in ElementTree.fromstring(chart).iter(f"{SVG}text")}
    assert float(texts["0"].get("x") or 0) == pytest.approx(x0)
    assert float(texts["8"].get("x") or 0) == pytest.approx(x1)
    assert float(texts["20"].get("y") or 0) - 4 == pytest.approx(y0)
    assert float(texts["32"].get("y") or 0) - 4 == pytest.approx(y1)


def test_texts_lie_inside_the_page() -> None:
    chart = line_chart("t", "x", "y", [Line("a", [(0.0, 20.0), (8.0, 32.0)])])
    for text in ElementTree.fromstring(chart).iter(f"{SVG}text"):
        assert 0 <= float(text.get("x") or -1) <= WIDTH
        assert 13 <= float(text.get("y") or -1) <= HEIGHT


finite = st.floats(-1e6, 1e6, allow_nan=False)


@given(st.lists(st.tuples(finite, finite), min_size=2, max_size=20))
@settings(max_examples=80, deadline=None)
def test_every_line_lies_inside_the_page(points: list[tuple[float, float]]) -> None:
    for _, places in paths_of(line_chart("t", "x", "y", [Line("a", points)])):
        assert all(-0.1 <= x <= WIDTH + 0.1 and -0.1 <= y <= HEIGHT + 0.1 for x, y in places)


@given(st.lists(finite, min_size=1, max_size=9))
@settings(max_examples=80, deadline=None)
def test_ticks_enclose_the_values_and_are_few(values: list[float]) -> None:
    ticks = _ticks(values)
    slack = 1e-6 * (ticks[-1] - ticks[0])
    assert ticks[0] - slack <= min(values) and max(values) <= ticks[-1] + slack
    assert 2 <= len(ticks) <= 9


def test_ticks_are_round() -> None:
    assert _ticks([]) == [0, 0.2, 0.4, 0.6, 0.8, 1]
    assert _ticks([0, 8]) == [0, 2, 4, 6, 8]
    assert _ticks([20.3, 36.1]) == [20, 25, 30, 35, 40]
    assert _ticks([0.12, 0.17]) == [0.12, 0.13, 0.14, 0.15, 0.16, 0.17]


@given(finite, st.one_of(st.just(0.0), st.floats(1e-9, 1e6)))
@settings(max_examples=80, deadline=None)
def test_ticks_are_told_apart(low: float, span: float) -> None:
    labels = [f"{tick:g}" for tick in _ticks([low, low + span])]
    assert len(set(labels)) == len(labels)


def test_without_lines_there_are_axes_still() -> None:
    chart = line_chart("t", "x", "y", [Line("a", []), Line("b", [(1.0, 2.0)])])
    assert not paths_of(chart)
    assert ElementTree.fromstring(chart).tag == f"{SVG}svg"


def test_values_too_small_to_tell_apart_are_one() -> None:
    ((_, places),) = paths_of(line_chart("t", "x", "y", [Line("a", [(0.0, 5e-324), (1.0, 0.0)])]))
    assert len(places) == 2


def test_labelled_points_are_dots_on_the_line() -> None:
    points = [(0.0, 20.0), (4.0, 30.0), (8.0, 22.0)]
    chart = line_chart("t", "x", "y", [Line("a", points, ["p", "q & <r>", "s"])], (300, 200))
    ((_, places),) = paths_of(chart)
    dots = [c for c in ElementTree.fromstring(chart).iter(f"{SVG}circle") if len(c)]
    assert [(float(d.get("cx") or 0), float(d.get("cy") or 0)) for d in dots] == places
    assert [dot[0].text for dot in dots] == ["p", "q & <r>", "s"]
    assert all(0 <= x <= 300 and 0 <= y <= 200 for x, y in places)
    assert ElementTree.fromstring(chart).get("viewBox") == "0 0 300 200"
