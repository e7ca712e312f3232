"""Files are whole or as they were, and JSON is strict."""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import (
    read_json,
    remove_leftovers,
    replacing,
    write_json,
    written_apart,
)


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


@pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be flushed there")
@pytest.mark.parametrize(("durable", "flushed"), [(True, ["file", "folder"]), (False, [])])
def test_a_file_and_then_its_name_are_brought_to_the_disk(
    tmp_path: Path, monkeypatch: Any, durable: bool, flushed: list[str]
) -> None:
    path, done, fsync = tmp_path / "a.txt", list[str](), os.fsync

    def watched(descriptor: int) -> None:
        folder = os.path.samestat(os.fstat(descriptor), tmp_path.stat())
        assert path.exists() == folder  # the file before it gets its name, the folder after that
        done.append("folder" if folder else "file")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    with replacing(path, durable) as beside:
        beside.write_text("new")
    assert done == flushed and path.read_text() == "new"


def test_a_file_that_cannot_be_brought_to_the_disk_is_not_written(
    tmp_path: Path, monkeypatch: Any
) -> None:
    def fail(_: int) -> None:
        raise OSError(5, "Input/output error")

    (tmp_path / "a.txt").write_text("old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(DataError, match="Input/output error"), replacing(tmp_path / "a.txt") as new:
        new.write_text("new")
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_only_what_we_have_left_unfinished_is_removed(tmp_path: Path) -> None:
    names = (
        ".tmpAbc123",
        ".a.part",
        ".gsdmsr-12.part",
        "a.part.txt",
        ".gsdmsr-" + 32 * "g" + ".part",
    )
    for name in names:
        (tmp_path / name).touch()
    left, begun = list[Path](), list[Any]()
    for name in ("a.txt", "a" * 200 + ".txt"):
        begun += replacing(tmp_path / name), written_apart(tmp_path / name)
        left += begun[-2].__enter__(), begun[-1].__enter__().parent  # as a kill leaves them
        left[-2].write_text("half")
    remove_leftovers(tmp_path, "a.txt")
    assert [path.exists() for path in left] == [False, False, True, True]
    remove_leftovers(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(names)
