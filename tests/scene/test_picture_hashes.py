"""Hashes of pictures: what they notice, what they do not, and what they say of it."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.picture_hashes import BLOCK, difference, digest, sampled, whole

SIZE = 10 * BLOCK


@pytest.fixture
def paths(tmp_path: Path) -> list[Path]:
    (tmp_path / "images").mkdir()
    found = [tmp_path / "images" / f"{i}.png" for i in range(3)]
    for i, path in enumerate(found):
        path.write_bytes(bytes([i]) * SIZE)
    return found


def overwrite(path: Path, place: int) -> None:
    with path.open("r+b") as file:
        file.seek(place)
        file.write(b"\xff")


def test_a_sample_is_the_size_and_three_blocks(paths: list[Path], tmp_path: Path) -> None:
    content = bytes(range(256)) * (SIZE // 256)
    paths[0].write_bytes(content)
    middle = SIZE // 2
    blocks = content[:BLOCK] + content[middle : middle + BLOCK] + content[-BLOCK:]
    expected = hashlib.sha256(f"{SIZE}\0".encode() + blocks).hexdigest()[:16]
    assert sampled(tmp_path, paths)["images/0.png"] == expected
    assert whole(tmp_path, paths)["images/0.png"] == hashlib.sha256(content).hexdigest()[:16]


@pytest.mark.parametrize(
    ("place", "noticed"),
    [(0, True), (SIZE // 2 + BLOCK - 1, True), (SIZE - 1, True), (2 * BLOCK, False)],
)
def test_what_changes_is_noticed_where_the_sample_is_and_whole_hashes_notice_all(
    paths: list[Path], tmp_path: Path, place: int, noticed: bool
) -> None:
    before = sampled(tmp_path, paths), whole(tmp_path, paths)
    overwrite(paths[1], place)
    after = sampled(tmp_path, paths), whole(tmp_path, paths)
    assert (after[0] != before[0]) == noticed and after[1] != before[1]
    assert difference(after[1], before[1]) == "images/1.png has changed"


def test_a_copy_is_the_same_wherever_it_lies_and_whenever_it_was_made(
    paths: list[Path], tmp_path: Path
) -> None:
    before = sampled(tmp_path, paths)
    (tmp_path / "elsewhere").mkdir()
    moved = (tmp_path / "images").rename(tmp_path / "elsewhere" / "images")
    copies = [moved / path.name for path in paths]
    os.utime(copies[0], (1, 1))
    after = sampled(tmp_path / "elsewhere", reversed(copies))
    assert after == before and digest(after) == digest(before)


def test_a_difference_names_a_file() -> None:
    old = {"a": "1", "b": "2", "c": "3"}
    assert difference(old, old) is None
    assert difference(old | {"c": "4", "b": "5"}, old) == "b and 1 more have changed"
    assert difference(old | {"d": "4"}, old) == "d is new"
    assert difference({"a": "1", "c": "3"}, old) == "b is not there any more"


def test_a_file_that_cannot_be_read_is_named(paths: list[Path], tmp_path: Path) -> None:
    paths[1].unlink()
    for read in (sampled, whole):
        with pytest.raises(DataError, match=r"1\.png: cannot be read: No such file"):
            read(tmp_path, paths)
