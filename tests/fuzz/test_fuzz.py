"""A taste of the long run of ``run.py``: a few damaged inputs for every entry point."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from pathlib import Path
from random import Random

import guard
import pytest
from guard import ViolationError, hold, watched
from hypothesis import example, given, settings
from hypothesis import strategies as st
from targets import Target, targets

from gsdmsr_cli.ground.errors import DataError

INPUTS = 25


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Target]]:
    folder = tmp_path_factory.mktemp("fuzz")
    return folder, targets(folder)


def test_valid_files_are_read_and_damaged_ones_differ(made: tuple[Path, list[Target]]) -> None:
    """Otherwise nothing behind the first check of a reader would be reached."""
    for target in made[1]:
        if target.path.exists():
            target.read(target.path)
        inputs = {target.mutate(Random(i)) for i in range(30)}
        assert len(inputs) > 20, target.name
        assert target.mutate(Random(7)) == target.mutate(Random(7)), target.name


def test_damaged_files_end_in_a_sentence(made: tuple[Path, list[Target]]) -> None:
    folder, found = made

    @settings(max_examples=INPUTS, derandomize=True, deadline=None, database=None)
    @given(st.integers(0, 2**32))
    @example(0)
    def each(number: int) -> None:
        for target in found:
            valid = target.path.read_bytes() if target.path.exists() else None
            target.path.write_bytes(target.mutate(Random(f"{target.name}/{number}")))
            try:
                hold(lambda target=target: target.read(target.path), folder)
            except Exception as error:
                raise AssertionError(f"{target.name}, input {number}: {error!r}") from error
            finally:
                if valid is not None:
                    target.path.write_bytes(valid)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        each()


def _reads_outside() -> None:
    Path("/etc/hostname").open().close()


def _writes(folder: Path) -> None:
    (folder / "new").write_text("x")


def _raises(error: Exception) -> None:
    raise error


def test_what_no_reader_may_do_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "SECONDS", 0.2)
    (tmp_path / "inside").write_text("x")
    hold(lambda: (tmp_path / "inside").read_text(), tmp_path)
    for wrong, message in (
        (_reads_outside, "/etc/hostname' was opened"),
        (lambda: _writes(tmp_path), "opened for writing"),
        (lambda: (tmp_path / "inside").unlink(), "os.remove"),
        (lambda: os.system("true"), "os.system"),
        (lambda: subprocess.run([sys.executable, "-V"], check=False), "subprocess.Popen"),
        (lambda: _raises(DataError("")), "not a printable line"),
        (lambda: sum(range(4 * 10**7)), r"took \d"),
    ):
        with pytest.raises(ViolationError, match=message):
            hold(wrong, tmp_path)
    with pytest.raises(KeyError):
        hold(lambda: _raises(KeyError("a")), tmp_path)


def test_nothing_is_watched_outside_of_a_block(tmp_path: Path) -> None:
    with watched(tmp_path):
        pass
    _writes(tmp_path)
