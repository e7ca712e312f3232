"""Pieces of HTML: figures that say what they round, and text that stays text."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.reporting.markup import at, bars, figure, table, terms

DOCUMENT = {"a": {"b": [{"c": 1.25}, {"c": None}]}, "n": 7}


@pytest.mark.parametrize(
    ("path", "value"), [("a.b.0.c", 1.25), ("a.b.1.c", None), ("n", 7), ("x", None), ("n.y", None)]
)
def test_values_are_found_by_their_path(path: str, value: object) -> None:
    assert at(DOCUMENT, path) == value


@given(st.floats(-1e6, 1e6))
def test_a_figure_carries_the_very_value_that_it_rounds(value: float) -> None:
    element = ElementTree.fromstring(figure({"x": value}, "x", ".3f"))
    assert float(element.get("value") or "nan") == value and element.get("data-of") == "x"
    assert float(element.text or "nan") == pytest.approx(value, abs=5.0001e-4)


def test_figures_may_be_whole_missing_or_in_other_units() -> None:
    assert ">7<" in figure(DOCUMENT, "n", "d")
    assert figure(DOCUMENT, "a.b.1.c") == "none"
    element = ElementTree.fromstring(figure({"x": 2_500_000}, "x", ".2f", 1e6))
    assert (element.text, element.get("value")) == ("2.50", "2500000")


def test_tables_and_lists_are_well_formed_and_escape_text() -> None:
    root = ElementTree.fromstring(bars([("a <b>", "1 s", 1.0), ("c", "4 s", 4.0)]))
    assert [th.text for th in root.iter("th")] == ["a <b>", "c"]
    assert [span.get("style") for span in root.iter("span")] == ["width:25.0%", "width:100.0%"]
    assert ElementTree.fromstring(bars([("a", "0 s", 0.0)])).find(".//span") is not None
    root = ElementTree.fromstring(terms([("a & b", "<c>")]))
    assert [element.text for element in root] == ["a & b", "<c>"]
    assert table(("", "x"), [("a", "1"), ("b", "2")]).count("<td") == 2
