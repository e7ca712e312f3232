"""Files are whole or as they were, and JSON is strict."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, replacing, write_json


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_json_has_no_value_that_is_not_finite(tmp_path: Path, value: float) -> None:
    """What stood there before stays, and nothing else is left behind."""
    path = tmp_path / "new" / "a.json"
    write_json(path, {"a": [1, 2.5, "é"]})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": [{"b": value}]})
    assert read_json(path) == json.loads(path.read_text("utf-8")) == {"a": [1, 2.5, "é"]}
    assert list(path.parent.iterdir()) == [path]


def test_what_fails_half_way_leaves_the_file_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(DataError, match=r"a\.txt: cannot be written"), replacing(path) as beside:
        assert beside.parent == tmp_path and beside.suffix == ".txt" and beside != path
        beside.write_text("half")
        raise OSError(28, "No space left on device")
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with replacing(path) as beside:
        beside.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("content", ["", "{", "[1]", "3", '"a"'])
def test_what_is_no_json_object_is_damaged(tmp_path: Path, content: str) -> None:
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(DataError, match=r"a\.json: damaged"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "[1, NaN]"])
def test_numbers_that_json_has_not_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(f'{{"value": {text}}}')
    with pytest.raises(DataError, match=r"a\.json: damaged: -?\w+ is not a number that JSON has"):
        read_json(path)


def test_json_that_is_nested_too_deeply_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"a":' * 100_000)
    with pytest.raises(DataError, match="nested too deeply"):
        read_json(path)
