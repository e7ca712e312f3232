"""A stage is there whole or not at all, and is not made twice."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from gsdmsr_cli.capture.stages import Stages
from gsdmsr_cli.ground.errors import DataError


def test_a_stage_is_made_once_for_each_key(tmp_path: Path) -> None:
    stages, made = Stages(tmp_path / "stages"), []

    def make(folder: Path) -> None:
        made.append(folder)
        (folder / "a").write_text(str(len(made)))

    first = stages.run("one", {"n": 1}, make)
    assert stages.run("one", {"n": 1}, make) == first
    other = stages.run("one", {"n": 2}, make)
    assert other != first and len(made) == 2
    assert (first / "a").read_text() == "1" and (other / "a").read_text() == "2"
    stages.remove()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("x")], ids=repr)
def test_a_stage_that_fails_is_not_there(tmp_path: Path, error: BaseException) -> None:
    stages = Stages(tmp_path)

    def fail(folder: Path) -> None:
        (folder / "half").touch()
        raise error

    with pytest.raises(type(error)):
        stages.run("one", {}, fail)
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_told_in_one_sentence(tmp_path: Path) -> None:
    def fail(folder: Path) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(folder / "x"))

    with pytest.raises(DataError, match="No space left on device; free space") as caught:
        Stages(tmp_path).run("one", {}, fail)
    assert "\n" not in str(caught.value)


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path) -> None:
    (tmp_path / ".one.part").mkdir()
    (tmp_path / ".one.part" / "half").touch()
    made = Stages(tmp_path).run("one", {}, lambda folder: (folder / "whole").touch())
    assert [path.name for path in made.iterdir()] == ["whole"]
    assert list(tmp_path.iterdir()) == [made]
